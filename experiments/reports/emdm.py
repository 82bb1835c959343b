"""Tables of EMDM (Zhou et al. 2024, ECCV)."""

from reports.claims import Claim, Column, Row, Source, Table


def source(run: str, train: str, evaluate: str = "") -> Source:
    """A run of emdm.py.

    Args:
      run: Its folder.
      train: Options of the training.
      evaluate: Options of the evaluation, with a blank before them.

    Returns:
      The source.
    """
    return Source(
        run=run,
        file="evaluation/metrics.json",
        commands=(
            f"python experiments/emdm.py train --out {{run}} {train}",
            f"python experiments/emdm.py evaluate --run {{run}}{evaluate}",
        ),
    )


ACTION = source(
    "emdm_action",
    "--task action --rows emdm emdm_5 emdm_2 emdm_1 naive ddpm_50 ddpm_1000",
)
TEXT = source("emdm_text", "--task text --rows emdm ddpm_1000")
NOTHING = source("emdm_none", "--task none --rows emdm ddpm_1000")
_JUDGE = "of another recognizer"
R1, R2, R3 = (
    Column(
        name=f"Top {n}",
        here=f"R-precision {n}",
        better="higher",
        judged=True,
        note="R-precision in pools of 32, of another matcher",
    )
    for n in (1, 2, 3)
)
FID = Column(name="FID", here="FID", better="lower", judged=True, note=_JUDGE)
MATCHING = Column(
    name="MM Dist", here="MM-Dist", better="lower", judged=True, note=_JUDGE
)
DIVERSITY = Column(
    name="Diversity", here="diversity", better="real", judged=True, note=_JUDGE
)
MULTIMODALITY = Column(
    name="MModality", here="multimodality", better="higher", judged=True, note=_JUDGE
)
TIME = Column(
    name="ms a frame",
    here="ms a frame",
    better="lower",
    kind="time",
    note="at batch 1, this machine; the middle half of the calls",
)

_MDM = "a diffusion model of EMDM's size in place of MDM."
_TEXT = (
    (0.498, 0.007),
    (0.684, 0.006),
    (0.786, 0.006),
    (0.112, 0.019),
    (3.110, 0.027),
    (9.551, 0.078),
    (1.641, 0.078),
)

TABLE_1 = Table(
    paper="EMDM",
    number="1",
    title="motions from texts",
    source=TEXT,
    columns=(R1, R2, R3, FID, MATCHING, DIVERSITY, MULTIMODALITY, TIME),
    rows=(
        Row(
            name="Real",
            here="real (held-out clips)",
            paper=(
                (0.511, 0.003),
                (0.703, 0.003),
                (0.797, 0.002),
                (0.002, 0.0),
                (2.974, 0.008),
                (9.503, 0.065),
                None,
                None,
            ),
        ),
        Row(
            name="MDM",
            here="ddpm_1000",
            paper=(
                (0.418, 0.005),
                (0.605, 0.005),
                (0.708, 0.005),
                (0.508, 0.034),
                (3.630, 0.023),
                (9.373, 0.094),
                (2.880, 0.088),
                (62.505, 0.071),
            ),
        ),
        Row(name="EMDM (Ours)", here="emdm", paper=(*_TEXT, (0.280, 0.002))),
    ),
    claims=(
        Claim(
            words="EMDM has a lower FID than MDM",
            column="FID",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="table 1",
        ),
        Claim(
            words="EMDM matches texts better than MDM (top 1)",
            column="Top 1",
            pairs=(("MDM", "EMDM (Ours)"),),
            where="section 4.3, table 1",
        ),
        Claim(
            words="recorded motion matches texts better than EMDM (top 1)",
            column="Top 1",
            pairs=(("EMDM (Ours)", "Real"),),
            where="table 1",
        ),
        Claim(
            words="EMDM is at least 110 times as fast as MDM (our bar: half of "
            "the table's 223)",
            column="ms a frame",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="section 4.2, table 1",
            factor=110.0,
        ),
    ),
    note="Paper: HumanML3D; here: captions of Bandai-Namco, made by a grammar; " + _MDM,
)

TABLE_3 = Table(
    paper="EMDM",
    number="3",
    title="motions from actions",
    source=ACTION,
    columns=(
        FID,
        Column(name="ACC", here="accuracy", better="higher", judged=True, note=_JUDGE),
        DIVERSITY,
        Column(
            name="MM", here="multimodality", better="real", judged=True, note=_JUDGE
        ),
        TIME,
    ),
    rows=(
        Row(
            name="Real",
            here="real (training clips)",
            paper=(
                (0.020, 0.010),
                (0.997, 0.001),
                (6.850, 0.050),
                (2.450, 0.040),
                None,
            ),
        ),
        Row(
            name="MDM",
            here="ddpm_1000",
            paper=(
                (0.100, 0.0),
                (0.990, 0.0),
                (6.860, 0.050),
                (2.520, 0.010),
                (41.154, 0.162),
            ),
        ),
        Row(
            name="EMDM (Ours)",
            here="emdm",
            paper=(
                (0.084, 0.004),
                (0.991, 0.003),
                (6.876, 0.148),
                (2.417, 1.009),
                (0.337, 0.005),
            ),
        ),
    ),
    claims=(
        Claim(
            words="EMDM has a lower FID than MDM",
            column="FID",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="section 4.4, table 3",
        ),
        Claim(
            words="EMDM's actions are recognized more often than MDM's",
            column="ACC",
            pairs=(("MDM", "EMDM (Ours)"),),
            where="table 3",
        ),
        Claim(
            words="EMDM's multimodality is nearer to the data's than MDM's",
            column="MM",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="table 3",
            toward="Real",
        ),
        Claim(
            words="EMDM is at least 100 times as fast as MDM (our bar; the table "
            "has 122)",
            column="ms a frame",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="section 4.4, table 3",
            factor=100.0,
        ),
    ),
    note="Paper: HumanAct12; here: 15 actions of Bandai-Namco 1 and 2; " + _MDM,
)

TABLE_B6 = Table(
    paper="EMDM",
    number="B6",
    title="motions from nothing",
    source=NOTHING,
    columns=(FID, DIVERSITY, TIME),
    rows=(
        Row(name="Real", here="real (training clips)", paper=(0.002, 9.503, None)),
        Row(name="MDM", here="ddpm_1000", paper=(8.84, 6.429, (62.505, 0.071))),
        Row(name="EMDM (Ours)", here="emdm", paper=(3.46, 8.759, (0.280, 0.002))),
    ),
    claims=(
        Claim(
            words="EMDM has a lower FID than MDM",
            column="FID",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="section B, table B6",
        ),
        Claim(
            words="EMDM's diversity is nearer to the data's than MDM's",
            column="Diversity",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="table B6",
            toward="Real",
        ),
        Claim(
            words="EMDM is at least 110 times as fast as MDM (our bar: half of "
            "the table's 223)",
            column="ms a frame",
            pairs=(("EMDM (Ours)", "MDM"),),
            where="section B, table B6",
            factor=110.0,
        ),
    ),
    note="Paper: a part of AMASS; here: Bandai-Namco 1 and 2; " + _MDM,
)
