"""CAMDM: a transformer that steers a character in many styles, in 8 steps.

Source: R. Chen, M. Shi, S. Huang, P. Tan, T. Komura, X. Chen, "Taming Diffusion
Probabilistic Models for Character Control", SIGGRAPH 2024.

What differs
------------

Where the paper and the released code differ, the default of the library is the paper's,
and the released variant is a named option, but for what the list names.

* diffusion steps: 8; released code: `model.Config(num_steps=4)`.
* style change: scale of the guidance on the past: 0.7; released code: 0.5, in
  `controller.RELEASED`.
* style change: guided plans: 1; released code: 2, in `RELEASED`.
* plans after the start: not guided; released code: the first 2 are guided, in
  `RELEASED`.
* points that HFTE reflects: 15; released code: 23, in `RELEASED`.
* facing of those points: the last one is held, as released (the paper copies theirs);
  released code: the same.
* new plan: when the command changes, or after 15 frames; released code: every 15
  frames, in `RELEASED`.
* exponent of the blend of positions: 0.7, as in the released scene (the paper has
  none); released code: 0.4, in `RELEASED`.
* metrics: as the paper defines them, angles wrapped; released code: columns with
  `camdm_release` in their names, of whole clips: what `report.py` sets beside the
  paper's values.
* fifth loss (velocities of positions), not in the paper's equation: weight 1; released
  code: the same; `weight_position_velocity=0.0` turns it off.

The paper does not give the width of the network, its layers, or the layout of
rotations: these are the released code's; so are places relative to the last past pose
(the paper's are relative to the first), the random yaw of samples and the smoothed
paths of training (facings are smoothed within the window, there within the clip). Three
things of the released run-time are not offered: it smooths commands by interpolation
(here springs), solves the seam of two plans anew in every tick (here once per plan, so
that velocity is continuous; see `jaxmotion/control/inertia.py`), and takes the facing
of what it displays from the root joint's own axis (here from the hips, as in training;
`jaxmotion/motion/facing.py`).

Options of our own, all off in `model.Config()` and in `train --preset paper`:

* `frames_per_token=5`: five frames are one token: 31 tokens instead of 147.
* `token_margin=4`: each output token predicts four frames more on either side,
  cross-faded with its neighbors': motion no longer jumps where tokens meet.
* `heading="facing"`: samples face +z, instead of a random yaw.
* `rotation_scale=4.0`: rotations are centered and scaled to about unit variance.
* `norm="pre"`: layer norms before the branches instead of after the sums.
* other weights of the losses: see `training.PRESETS` for them, and why.
* `train --optimizer muon`: Muon in place of AdamW: 0.022 instead of 0.049 after 1000
  steps of the walker.
* `train --warmup 300 --max-norm 1 --ema 0.999`: a rate that rises first, clipped
  gradients, averaged parameters.
* `train --initial-scale 0.3`: linear layers begin with a third of Flax's weights:
  lower losses for as many updates; 0.577, in `--preset paper`, is about PyTorch's, and
  1, Flax's, is what shipped models and the tables of claims began with.
* `attention="prefix"`: condition tokens do not see the noisy frames, and are computed
  once per plan; `noise_levels=4`: a window is noised at four levels, its condition
  encoded once; `train --balance 0.5`: windows of rare speeds and turns are drawn more
  often. The shipped `locomotion` is trained so.
* `seam_half_life=15`: predictions go on from the last past pose, which the network
  alone misses by 2 cm a joint, and losses reach over the seam; `own_levels=0.5`: half
  of the windows are noised, at lower levels, on the network's own predictions, as in
  sampling. `locomotion` was trained so last; it plans in 2 calls as well as in 8 when
  it goes straight on, and more roughly in curves.
* `cubic_wishes=0.5`: half of the wanted paths in training are cubics fitted to the
  recorded ones. Recorded paths sway with each step and a command's do not: turning
  around, feet then slide half as fast. The last part of `locomotion` was trained so.
* `frame_kernel`: a convolution over frames after the tokens; `weight_acceleration`:
  second differences of positions (in `--preset planted`).
* `Control(follow=...)`: the wanted path returns to the commanded one.
* `controller.OWN_STARTS`: exponents of 3 in the blend with the path of the last plan;
  the shipped models answer a command 0.2 s earlier than with the paper's. Small changes
  of a command count once 8 frames of the plan were played (`Control.least`).
* A student of one or two network calls (`distillation.py`, `experiments/camdm.py
  distill`); `Model.steps` are the steps that a plan visits, `jm.load(..., steps=(8,))`
  or `steps=1` cuts any model short.
* Locked feet (`jaxmotion/control/foot_lock.py`): what is displayed is the past of the
  next plan.

`experiments/camdm.py train` starts from `--preset small`, which uses the first nine
and no dropout, since it is meant for a CPU; the shipped walker is such a model, without
margins, whose feet were planted by a second training (`--preset planted`). `--preset
paper` trains as the authors do (AdamW, 1e-4, batch 512; their 100 epochs are for
`--steps` to say); every such option can still be given. In every preset all clips get a
mirrored copy, where the release mirrors the symmetric styles only (`--no-mirror`), and
the rate falls with every step, there with every epoch. The evaluator that scores
styles has layer and group norms in place of batch norms (`evaluator.py import` takes
the released one).
"""
