"""EMDM: whole motions from an action or a text by a denoising-diffusion GAN."""
