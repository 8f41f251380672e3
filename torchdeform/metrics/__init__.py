"""How alike two images are, with derivatives, and how well labels and landmarks agree."""
