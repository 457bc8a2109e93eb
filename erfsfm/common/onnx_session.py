"""ONNX graphs in ONNX Runtime: its own operators alone, on the CPU."""

from __future__ import annotations

from onnxruntime import InferenceSession, SessionOptions

_FATAL = 4  # level of ONNX Runtime's own log; its errors are raised as well


def open_session(content: bytes, threads: int) -> InferenceSession:
    """A graph that is ready to run on that many threads; the exceptions of ONNX Runtime are raised as they are."""
    options = SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # costly on a shared machine
    return InferenceSession(content, options, providers=["CPUExecutionProvider"])
