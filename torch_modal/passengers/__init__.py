"""Points, splats and fine meshes that follow a coarser shape."""
