"""The verbs of the shell, one function each; `torchdeform.cli` makes commands of them."""
