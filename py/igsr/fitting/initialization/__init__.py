"""Initial splats of a fit, from points of the capture, depth maps, photos or at random."""
