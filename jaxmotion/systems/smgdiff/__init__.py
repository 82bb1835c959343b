"""SMGDiff: a soccer player and his ball, guided to touch each other.

Source: H. Yang, C. Li, Z. Wu, G. Li, J. Wang, J. Yu, Z. Su, L. Xu, "SMGDiff: Soccer
Motion Generation using diffusion probabilistic models", 2024, arXiv:2411.16216.

What differs
------------

SMGDiff's supplement, which has its networks and weights, was not to be had, and there
is no code. Its motion model is CAMDM's network with the paper's terms at weight 1, its
path generator a smaller one of ours. Other than in the paper: features are
standardized; the ball's weight is clamped to 0..1; the path is blended at every plan,
not only when the control changes. With `Guidance()` the last guided step is as long as
in DSG's released code. What `experiments/smgdiff.py` uses by default since trainings
here are short: `--preset small`, with losses of the ball and other weights (`--preset
paper` is without; `planted` is for a second training), and `smgdiff_guidance.TUNED`
(rate 0.9, touches from 12 m/s² on, within 18 cm) where the paper has 0.5, 2 m/s² and 10
cm (`Guidance()`). TUNED's last guided step is a 360th as long as that: the schedule
"end 1" then hardly guides, and "end 2" in the step before the last. The shipped
`dribble` draws its paths in four steps from noise as smooth as paths
(`trajectory.Config(noise="bridge")`) and for a second target half a second ahead
(`soon`); his wishes lead back to the commanded path, and ask for no turn that people do
not make (`controller.OWN_STARTS`). He runs after a ball that got more than a meter
away, which rolls by itself meanwhile (`Control.fetch`).
"""
