"""Interchange formats, one small module each."""

from collections.abc import Callable
from pathlib import Path

from slomo.errors import InvalidData
from slomo.motion import KeypointMotion


def load_keypoints(path: Path, *, note: Callable[[str], None] = lambda message: None) -> KeypointMotion:
    """Read key points from `keypoints.npz` or from a key-point JSON of SLoMo's authors.

    Args:
        path: file; its content decides, not its name.
        note: called once for each thing that had to be decided from the data (up axis, order of the limbs).

    Raises:
        InvalidData: neither format, truncated, or not finite.
    """
    from slomo.formats import npz, paper

    path = Path(path)
    try:
        with path.open("rb") as f:
            start = f.read(2)
    except OSError as e:
        raise InvalidData(e.strerror or "cannot be read", where=path, todo="give a key-point file") from None
    if not start:
        raise InvalidData("the file is empty", where=path, todo="give keypoints.npz or a key-point JSON")
    if start == b"PK":
        try:
            return KeypointMotion.from_arrays(npz.load(path))
        except InvalidData as e:
            raise e if str(path) in str(e) else InvalidData(str(e), where=path) from None
    return paper.load(path, note=note)
