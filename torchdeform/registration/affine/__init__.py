"""The alignment that comes first: maps of the affine group."""
