"""EMDM's ablations: number of steps, and weight of the geometric losses."""

from reports import emdm
from reports.claims import Claim, Row, Source, Table, chain

ABLATION = emdm.source(
    "emdm_ablation",
    "--task action --width 64 --depth 2 --steps 1000 "
    "--rows recon_0 recon_1 recon_10 recon_100 no_r1",
    " --samples 450 --replications 10",
)
SWEEP = Source(
    run="sweep_emdm",
    file="table.json",
    commands=(
        "python experiments/step_sweep.py --system emdm --steps 1 5 10 20 50 "
        "--out {run}",
    ),
)

NOTE = (
    "Paper: HumanML3D, from texts; here: 15 actions of Bandai-Namco 1 and 2, which "
    "have no R-precision or MM Dist."
)
COLUMNS = (emdm.FID, emdm.DIVERSITY, emdm.MULTIMODALITY)
_OURS, _STATED = (
    tuple(emdm.TABLE_1.stated(row, column.name) for column in COLUMNS)
    for row in ("EMDM (Ours)", "Real")
)
REAL = Row(name="Real", here="real (training clips)", paper=_STATED)

_STEPS = {
    "1": ((5.640, 0.127), (7.639, 0.071), (0.622, 0.016)),
    "5": ((1.306, 0.052), (9.168, 0.074), (2.285, 0.065)),
    "10": _OURS,
    "20": ((0.191, 0.028), (9.531, 0.074), (1.688, 0.057)),
    "50": ((0.216, 0.027), (9.482, 0.083), (1.788, 0.046)),
}
_FEWER = (
    Claim(
        words="fewer steps than 10 raise FID (10, 5, 1)",
        column="FID",
        pairs=chain("10 steps", "5 steps", "1 step"),
        where="section 5.1, table 4",
    ),
    Claim(
        words="fewer steps than 10 take diversity away from the data's (10, 5, 1)",
        column="Diversity",
        pairs=chain("10 steps", "5 steps", "1 step"),
        where="section 5.1, table 4",
        toward="Real",
    ),
    Claim(
        words="with 1 step multimodality is lower than with 10",
        column="MModality",
        pairs=(("1 step", "10 steps"),),
        where="section 5.1, table 4",
    ),
)


def _steps(*, only: tuple[str, ...], named: dict[str, str]) -> tuple[Row, ...]:
    return tuple(
        Row(
            name=f"{steps} step" + ("" if steps == "1" else "s"),
            here=named.get(steps),
            paper=_STEPS[steps],
            reason="no row of emdm.py; see the table by step_sweep.py",
        )
        for steps in only
    )


TABLE_4 = Table(
    paper="EMDM",
    number="4",
    title="number of steps",
    source=emdm.ACTION,
    columns=COLUMNS,
    rows=(
        REAL,
        *_steps(only=tuple(_STEPS), named={"1": "emdm_1", "5": "emdm_5", "10": "emdm"}),
    ),
    claims=_FEWER,
    note=NOTE,
)

TABLE_4_SWEEP = Table(
    paper="EMDM",
    number="4 (step_sweep.py)",
    title="number of steps, all trained alike",
    source=SWEEP,
    columns=COLUMNS,
    rows=(
        Row(
            name="Real",
            here="ground truth (held-out clips)",
            paper=REAL.paper,
        ),
        *_steps(only=tuple(_STEPS), named={n: f"T = {n}" for n in _STEPS}),
    ),
    claims=(
        *_FEWER,
        Claim(
            words="more steps than 10 raise FID (10, 20, 50)",
            column="FID",
            pairs=chain("10 steps", "20 steps", "50 steps"),
            where="table 4",
        ),
    ),
    note=NOTE,
)

_WEIGHTS = {
    "R = 0": ("recon_0", ((9.308, 0.190), (8.337, 0.086), (3.140, 0.079))),
    "R = 1": ("recon_1", ((0.449, 0.047), (9.445, 0.084), (1.978, 0.065))),
    "R = 10": ("recon_10", ((0.232, 0.034), (9.347, 0.076), (1.706, 0.037))),
    "R = 100": ("recon_100", _OURS),
}
TABLE_5 = Table(
    paper="EMDM",
    number="5",
    title="weight R of the geometric losses",
    source=ABLATION,
    columns=COLUMNS,
    rows=(
        REAL,
        *(
            Row(name=name, here=here, paper=paper)
            for name, (here, paper) in _WEIGHTS.items()
        ),
        Row(
            name="R = 1000",
            here=None,
            paper=((0.195, 0.026), (9.595, 0.084), (1.600, 0.045)),
            reason="no row of emdm.py",
        ),
    ),
    claims=(
        Claim(
            words="without the losses (R = 0) FID is much worse than with any weight",
            column="FID",
            pairs=tuple((name, "R = 0") for name in _WEIGHTS if name != "R = 0"),
            where="section 5.2, table 5",
        ),
        Claim(
            words="FID falls as R grows to 100",
            column="FID",
            pairs=chain("R = 100", "R = 10", "R = 1", "R = 0"),
            where="section 5.2, table 5",
        ),
    ),
    note=NOTE + " Here R weighs the features' error alone.",
)
