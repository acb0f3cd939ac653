"""How the denoiser is trained: pairs of renders, losses, perceptual distances, the training run."""
