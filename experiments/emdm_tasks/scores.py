"""Columns of the tables, in their order."""

ORDER = (
    "R-precision 1",
    "R-precision 2",
    "R-precision 3",
    "FID",
    "accuracy",
    "MM-Dist",
    "diversity",
    "multimodality",
)
