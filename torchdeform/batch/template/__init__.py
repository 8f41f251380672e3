"""Templates: the mean shape and intensity of many images."""
