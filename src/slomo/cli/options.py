"""The options of the commands that make artifacts from a clip or key points, and of the reference."""

from pathlib import Path
from typing import Annotated

import typer

SkeletonOption = Annotated[
    str | None,
    typer.Option("--skeleton", metavar="auto|quadruped|human|PATH", help="Whose bones to fit; auto: the clip tells."),
]
SegmenterOption = Annotated[
    str | None, typer.Option("--segmenter", metavar="auto|u2netp|still|motion|user", help="How the subject is found.")
]
MasksOption = Annotated[
    str | None, typer.Option("--masks", metavar="DIR|none", help="Your own masks, one image a frame.")
]
WeightsOption = Annotated[
    str | None, typer.Option("--weights", metavar="FILE|none", help="U2-Net-p weights (.onnx); none: look them up.")
]
StartOption = Annotated[float | None, typer.Option("--start", help="First second of the clip to use.")]
DurationOption = Annotated[float | None, typer.Option("--duration", help="Seconds to use; 0: all.")]
SlowMotionOption = Annotated[
    float | None,
    typer.Option("--slow-motion", help="How many times slower than life the clip plays; 0: as its file says."),
]
QualityOption = Annotated[
    str | None, typer.Option("--quality", metavar="draft|normal|high", help="How long to work on the reconstruction.")
]
LengthOption = Annotated[
    float | None, typer.Option("--length", help="Body length in metres (the clip alone cannot tell it).")
]
FovOption = Annotated[float | None, typer.Option("--fov", help="Horizontal field of view in degrees.")]
PriorOption = Annotated[
    str | None, typer.Option("--prior", metavar="auto|none|FILE", help="Network that sees parts and key points.")
]
Keypoints2dOption = Annotated[
    str | None, typer.Option("--keypoints2d", metavar="FILE|none", help="Your own 2-D key points (.json).")
]
ModelOption = Annotated[
    str | None, typer.Option("--keypoint-model", metavar="FILE|none", help="A key-point network of yours (.onnx).")
]
MapOption = Annotated[
    Path | None, typer.Option("--keypoint-map", help="What that network takes and gives (.toml), see docs/prior.md.")
]
TruthOption = Annotated[
    str | None,
    typer.Option(
        "--truth", metavar="FILE|none", help="truth.npz of a rendered clip: the report scores the reconstruction."
    ),
]
PlanModelOption = Annotated[
    str | None, typer.Option("--model", metavar="point-foot|whole-body", help="What the motion must be true for.")
]
SolverOption = Annotated[
    str | None, typer.Option("--solver", metavar="ddp|fatrop|ipopt", help="How it is solved, see docs/solvers.md.")
]
