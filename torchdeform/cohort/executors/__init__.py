"""Where the pairs of a cohort run: worker processes here, or a Dask cluster."""
