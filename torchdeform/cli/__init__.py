"""The commands of the shell, one file a verb."""
