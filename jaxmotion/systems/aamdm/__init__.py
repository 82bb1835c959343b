"""AAMDM: frame by frame in a learned space, a GAN drafts and diffusion polishes."""
