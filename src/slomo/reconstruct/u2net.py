"""Salient-object network U2-Net-p (Qin et al., Pattern Recognition 2020) run through onnxruntime."""

import hashlib
import os
from pathlib import Path

import cv2
import numpy as np

from slomo.errors import InvalidData

WEIGHTS_NAME = "u2netp.onnx"
WEIGHTS_URL = "https://github.com/danielgatis/rembg/releases/download/v0.0.0/u2netp.onnx"
WEIGHTS_SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"
WEIGHTS_VARIABLE = "SLOMO_U2NETP"
_SIDE = 320  # px, the network's input
_MEAN, _STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)


def find_weights() -> Path | None:
    """The weights at hand without any download: the file that SLOMO_U2NETP names, else the one in the user's cache.

    Raises:
        InvalidData: SLOMO_U2NETP names a file that is not there.
    """
    if named := os.environ.get(WEIGHTS_VARIABLE):
        if not Path(named).is_file():
            raise InvalidData("no such file", where=f"{WEIGHTS_VARIABLE}={named}", todo="name the weights or unset it")
        return Path(named)
    cached = _cache() / WEIGHTS_NAME
    return cached if cached.is_file() else None


def download_weights() -> Path:
    """Fetch the weights (4.6 MB, Apache-2.0) into the user's cache and check their SHA-256.

    Raises:
        InvalidData: the download failed or its content is not what it should be.
    """
    import pooch

    try:
        return Path(pooch.retrieve(WEIGHTS_URL, f"sha256:{WEIGHTS_SHA256}", fname=WEIGHTS_NAME, path=_cache()))
    except Exception as error:  # requests, URL and hash errors share no base class
        raise InvalidData(
            f"the weights could not be fetched ({error})",
            where=WEIGHTS_URL,
            todo=f"fetch {WEIGHTS_NAME} by hand and set {WEIGHTS_VARIABLE} to its path, or use --segmenter motion",
        ) from None


def _cache() -> Path:
    import pooch

    return Path(pooch.os_cache("slomo"))


class U2Net:
    """The loaded network. Raises `InvalidData` when the file is no ONNX network of that form."""

    def __init__(self, weights: Path, *, threads: int = 2):
        import onnxruntime

        self.digest = hashlib.sha256(Path(weights).read_bytes()).hexdigest()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(
                str(weights), sess_options=options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's own exceptions derive from Exception only
            raise InvalidData(f"not a network that can be loaded ({error})", where=weights) from None
        self._input = self._session.get_inputs()[0].name

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Probability of foreground (H, W) float32 of an RGB image (H, W, 3) uint8."""
        small = cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
        small = (small / max(float(small.max()), 1.0) - _MEAN) / _STD
        out = self._session.run(None, {self._input: small.transpose(2, 0, 1)[None]})[0]
        return cv2.resize(np.asarray(out)[0, 0], image.shape[1::-1], interpolation=cv2.INTER_LINEAR)

    def crop(self, image: np.ndarray, box: tuple[int, int, int, int]) -> np.ndarray:
        """As calling, on the box (x0, y0, x1, y1) alone; zero elsewhere."""
        x0, y0, x1, y1 = box
        out = np.zeros(image.shape[:2], np.float32)
        out[y0:y1, x0:x1] = self(image[y0:y1, x0:x1])
        return out
