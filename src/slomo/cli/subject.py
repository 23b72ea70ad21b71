"""The options that say who the subject is, when a clip shows several."""

from typing import Annotated, Any

import typer

from slomo.errors import UsageError

AtOption = Annotated[
    str | None,
    typer.Option("--subject-at", metavar="U,V[,S]|none", help="Of several, the one at this pixel (at this second)."),
]
BoxOption = Annotated[
    str | None,
    typer.Option("--subject-box", metavar="U0,V0,U1,V1[,S]|none", help="Of several, the one in this box of pixels."),
]


def chosen_subject(segmenter: str | None, at: str | None, box: str | None) -> dict[str, Any]:
    """How the subject is found and whom the user means, as parameters of the masks.

    "none" goes back to the largest; point and box unset each other.

    Raises:
        UsageError: both are given, or what is no list of numbers.
    """
    given = {"subject_at": at, "subject_box": box}
    wanted = {name: text for name, text in given.items() if text not in (None, "none")}
    if len(wanted) == 2:
        raise UsageError("a point and a box are given", where="--subject-at, --subject-box", todo="give one of them")
    changes: dict[str, Any] = dict.fromkeys(given) if wanted else {n: None for n, text in given.items() if text}
    for name, text in wanted.items():
        try:
            changes[name] = [float(x) for x in str(text).split(",")]
        except ValueError:
            where = "--" + name.replace("_", "-")
            raise UsageError(f"{text!r} is no list of numbers", where=where, valid=["for example 320,180"]) from None
    return changes if segmenter is None else changes | {"segmenter": segmenter}
