"""Tensors on grids: derivatives, warps, flows, fold checks, images and transforms. Nothing about registration."""
