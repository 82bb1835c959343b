"""The methods as compositions of diffusion, motion, networks and control."""
