"""What shapes carry: points, splats and fine meshes that follow a coarser one."""
