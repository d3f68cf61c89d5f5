"""What others open, made of a packed scene: points (PLY, LAS, LAZ) and Gaussians (3DGS PLY, SPZ, SOG, GLB). Pure encoders."""
