"""AAMDM: frame by frame in a learned space, a GAN drafts and diffusion polishes.

Source: T. Li, C. Qiao, G. Ren, K. Yin, S. Ha, "AAMDM: Accelerated Auto-regressive
Motion Diffusion Model", CVPR 2024, arXiv:2401.06146.

What differs
------------

The paper of AAMDM gives no sizes, weights or schedule, and there is no code: those here
are ours, or Learned Motion Matching's where the paper follows it. Two things of ours
keep short trainings alive: noise on the given previous frames in training
(`aamdm.Config(previous_noise=0.0)` is without; `train` has 0.5), and frames that are
kept within the bounds of the data in a rollout
(`aamdm_controller.controller(bounded=False)` is without). Two make feet stand: networks
that predict the change of a frame in its deviations (`Config(predict="frame")` is
without), and the polisher's errors measured in poses, too (`weight_pose`), and in how
fast slow toes move over the ground (`weight_foot`). Where the paper has equations,
these differ: the loss of changes (eq. 2) has local positions and rotations too, that of
the latent (eq. 3) also its absolute values and changes; velocities in eq. 8 are not
divided by the window's length; the GAN learns from three frames at a time (the paper
trains both modules on windows of ten), with a gradient penalty. Guidance (eq. 13) acts
in the chain's last step alone, which steers as well as all of them and costs less
(`guided_steps=None` guides all), and the path that is wished for begins no faster than
told.
"""
