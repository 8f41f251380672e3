"""Measures of how alike two images are, one file per family, and the features that they compare."""
