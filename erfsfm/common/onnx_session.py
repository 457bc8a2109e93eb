"""ONNX graphs in ONNX Runtime: its own operators alone, on the CPU."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

from onnxruntime import InferenceSession, RunOptions, SessionOptions

_FATAL = 4  # level of ONNX Runtime's own log; its errors are raised as well


def open_session(content: bytes, threads: int) -> InferenceSession:
    """A graph that is ready to run on that many threads; the exceptions of ONNX Runtime are raised as they are."""
    options = SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # costly on a shared machine
    return InferenceSession(content, options, providers=["CPUExecutionProvider"])


def run_limited(session: InferenceSession, output: str, inputs: dict[str, Any], limit_s: float) -> Any:
    """An output of a graph that may never end; signals are answered meanwhile.

    Raises:
        TimeoutError: it took longer than ``limit_s``; also as `open_session`.
    """
    options = RunOptions()
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(session.run, [output], inputs, options)
        try:
            return running.result(limit_s)[0]
        except BaseException:
            options.terminate = True
            raise
