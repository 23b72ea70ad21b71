"""A trained network as an ONNX file: weights stored as float16, computed in float32, with what its numbers mean."""

import io
import json
import warnings
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

from slomo.errors import UsageError
from slomo.prior.inference import METADATA, OUTPUTS
from slomo.prior.network import CHANNELS, STRIDE, Network

OPSET = 17
HALVED = 64  # initialisers with fewer numbers stay as they are


def require_onnx() -> None:
    """Raise `UsageError` where the package that writes .onnx files is not installed."""
    if find_spec("onnx") is None:
        raise UsageError("training needs the onnx package", where="train", todo="pip install 'slomo[train]'")


def onnx_bytes(network: Network, about: dict[str, Any]) -> bytes:
    """The network (its evaluation, batch norms folded) as the bytes of an .onnx file; equal for equal weights.

    Input "input" (N, 6, S, S) float32, N any, S any multiple of 32; outputs as `network.Output`.

    Args:
        about: goes into the file as JSON, `metadata_props["slomo"]`.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    training = network.training
    network.eval()
    sides = {"input": {0: "N", 2: "S", 3: "S"}} | {name: {0: "N"} for name in OUTPUTS}
    out = io.BytesIO()
    with warnings.catch_warnings():
        # The exporter by tracing: it folds batch norms and needs no further package. All shapes in the network follow
        # from the input's, so nothing that it traces is a constant.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (torch.zeros(2, CHANNELS, 4 * STRIDE, 4 * STRIDE),),
            out,  # pyright: ignore[reportArgumentType]
            input_names=["input"],
            output_names=list(OUTPUTS),
            dynamic_axes=sides,
            opset_version=OPSET,
            dynamo=False,
        )
    network.train(training)
    model = onnx.load_from_string(out.getvalue())
    casts = []
    for i, weight in enumerate(model.graph.initializer):
        if weight.data_type != TensorProto.FLOAT or np.prod(weight.dims) < HALVED:
            continue
        name, stored = weight.name, f"{weight.name}.half"
        half = numpy_helper.from_array(numpy_helper.to_array(weight).astype(np.float16), stored)
        model.graph.initializer[i].CopyFrom(half)
        casts.append(helper.make_node("Cast", [stored], [name], name=f"{name}.cast", to=TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    model.doc_string = model.graph.doc_string = ""
    for node in model.graph.node:
        node.doc_string = ""
    helper.set_model_props(model, {METADATA: json.dumps(about, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)
