"""EMDM: whole motions from an action or a text by a denoising-diffusion GAN.

Source: W. Zhou, Z. Dou, Z. Cao, Z. Liao, J. Wang, W. Wang, Y. Liu, T. Komura, W. Wang,
L. Liu, "EMDM: Efficient Motion Diffusion Model for Fast and High-Quality Motion
Generation", ECCV 2024, arXiv:2312.02256.

What differs
------------

EMDM's networks, losses and sizes are the released code's where it differs from the
paper (no skip connections, 512 channels of text; Adam with beta 0.5 and 0.9 for the
discriminator, and in the library for generators too:
`stages.Budget(optimizer="adam")`). Ours, on in `experiments/emdm.py` because trainings
here take minutes:

* one forward pass for both losses of the generator: the same expected gradient, a pass
  less; published: two passes.
* `norm="pre"`, `frames_per_token=4`, no dropout, Muon: learn faster; published:
  post-norm, 1, 0.1, Adam.
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
