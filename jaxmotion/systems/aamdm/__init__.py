"""AAMDM: frame by frame in a learned space, a GAN drafts and diffusion polishes.

Source: T. Li, C. Qiao, G. Ren, K. Yin, S. Ha, "AAMDM: Accelerated Auto-regressive
Motion Diffusion Model", CVPR 2024, arXiv:2401.06146.

What differs
------------

The paper gives RAdam at 1e-4, batches of 64 and a million updates for all networks,
windows of ten frames, three drafts, two polishes, and 64 channels of the embedding. It
gives no widths, weights, schedule, or latent size of the GAN, and there is no code:
those here are ours, or Learned Motion Matching's where the paper follows it. "Frame" in
`experiments/aamdm.py` is the row that comes nearest to it.

Training, in `experiments/aamdm.py`:

* 20,000 updates of AdamW (autoencoder), 5,000 of Muon (polisher) and 8,000 of RAdam at
  2e-4 (both players of the GAN), with averaged parameters; published: above.
* 256 channels, a cosine schedule, a latent of 64.
* windows of four for the polisher, in batches of 128, and of three for the GAN;
  published: ten, 64.
* `Config(levels="own")` is an option: each network learns the steps that the chain asks
  it for; published, as far as one can tell, all.
* noise on the given previous frames (`previous_noise=0.5`), so that a rollout comes
  back after leaving the data; published: none.
* half of the GAN's previous frames are the generator's own (`own_previous`), with an R1
  penalty of 0.05; published: not said.

Losses:

* networks predict the change of a frame in its deviations; published, and
  `Config(predict="frame")`: the frame.
* the polisher's errors are measured in poses, too (`weight_pose`), and in how fast slow
  toes move over the ground (`weight_foot`); published: neither.
* eq. 2, of changes, has local positions and rotations, too; eq. 3, of the latent, its
  absolute values and changes. Velocities in eq. 8 are not divided by the window's time.

Run-time:

* frames are kept within the bounds of the data; published, and `controller(
  bounded=False)`: not.
* noise of the posteriors may be remembered (`noise_half_life`; 0 as published). Tables
  that use it say so, and give it to AAMDM's own rows alone.
* `held=True` is an option: the previous frame, noised to the step where polishing
  begins, stands for the drafts, so that a frame takes two calls; published: drafts.
* guidance (eq. 13) acts in the chain's last step alone, which steers as well as all of
  them and costs less; published, and `guided_steps=None`: in all.
* the path that is wished for begins no faster than told. Whoever stands is asked to go
  .5 m/s faster than told until he moves, in the shipped model alone (`start`).
"""
