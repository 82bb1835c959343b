"""Motion data: BVH files, ragged clips, windows on the device, a made walker."""
