"""From files to files: what one command does."""
