"""EMDM: whole motions from an action or a text by a denoising-diffusion GAN.

Source: W. Zhou, Z. Dou, Z. Cao, Z. Liao, J. Wang, W. Wang, Y. Liu, T. Komura, W. Wang,
L. Liu, "EMDM: Efficient Motion Diffusion Model for Fast and High-Quality Motion
Generation", ECCV 2024, arXiv:2312.02256.

What differs
------------

EMDM's networks, losses and sizes are the released code's where it differs from the
paper (no skip connections, 512 channels of text; Adam with beta 0.5 and 0.9 for both
players). Ours, on in `experiments/emdm.py` because trainings here take minutes:

* Muon at 2e-3 for generators and Adam at 5e-4 for the discriminator, both falling to a
  twentieth, within 5,000 updates of batches of 32; published: Adam at 2e-5 (actions:
  3e-5) and 1.25e-4, as good as constant over 400,000 updates and more, batches of 64
  (`--optimizer adam --learning-rate 3e-5 --discriminator-rate 1.25e-4`).
* parameters averaged by 0.999; published: 0.9999.
* 128 channels, 4 layers and 4 heads; published: 1,024, 12 and 32.
* `token_margin=3`: tokens of four frames share three with their neighbors; published:
  tokens of one frame.
* `weigh_levels="posterior"` and `fade_geometry` are options: errors count less at noisy
  steps; published: alike at all. So are errors of joints' displacements and their
  differences (`weight_position_velocity`, `weight_acceleration`); published: none.
* rows "few_1", "few_2", "few_3", "few_5" and "few_10": so many steps, all but the first
  through less noise, and a discriminator that shares its weights over time and judges
  all but the last (of one, that one), by relativistic losses with penalties at both
  pairs; published: ten steps of one schedule, an MLP that judges all.
* one forward pass for both losses of the generator: the same expected gradient, a pass
  less; published: two passes.
* `norm="pre"` and no dropout: learn faster; published: post-norm, 0.1.
* weights begin as Flax's do; published: as PyTorch's, which are smaller.
* `mask_frames=True`: zeros after a motion's end are seen by nobody; each frame of a
  batch counts the same in the losses; published: `mask_frames=False`
  (`--no-mask-frames`): attention and discriminator see the zeros; losses are of each
  motion's own frames, and each motion counts the same.
* `geometry="world"`, steps of the root: joint losses in the world, paths without
  jitter; published: relative to the root, places.
* `train --text-form unit`: vectors of whole texts, scaled to mean square 1; the only
  form of WordLlama and hashed n-grams, which no release has; published: `--text-form
  released`, the default with CLIP: vectors as they are, of a text's first 20 tokens
  (there in float16, here in float32).
* `evaluate --padding zeros`: the evaluator sees zeros beyond the end of generated
  motions, as beyond that of real ones; published: `--padding kept`: the model's output
  there.
* feet stand below 0.2 m/s: the same speed at any rate; published: 0.01 m per frame at
  any rate.
* actions drawn uniformly: rare actions count as much; published: clips drawn uniformly.
* `hip_weight` of `humanml_layout.Layout`: facing from hips and shoulders; -1 swaps the
  hips as the published features do; published: -1.
"""
