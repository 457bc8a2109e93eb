"""Trainings in processes of their own."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from erfsfm.config import ExperimentConfig, dump_yaml


def _free_port() -> int:
    with socket.socket() as each:
        each.bind(("127.0.0.1", 0))
        return int(each.getsockname()[1])


@pytest.fixture
def in_processes() -> Callable[..., None]:
    """Trains by a configuration in as many processes as it names."""

    def run(config: ExperimentConfig, output: Path, resume: bool = False, before: str = "") -> None:
        """Train in as many processes as the configuration names; each first runs the lines ``before``.

        Lightning starts the script again for a second device.
        """
        script, file = output.with_suffix(".py"), output.with_suffix(".yaml")
        script.write_text(
            "import sys\nfrom pathlib import Path\nfrom erfsfm.config import load_experiment\n"
            "from erfsfm.training.module import SelfSupervision\nfrom erfsfm.training.run import train\n"
            f"{before}\n"
            "if __name__ == '__main__':\n"
            "    train(load_experiment(sys.argv[1]), Path(sys.argv[2]), '--resume' in sys.argv, device='cpu')\n"
            "    print('trained')\n"
        )
        file.write_text(dump_yaml(config))
        command = [sys.executable, str(script), str(file), str(output), *(["--resume"] if resume else [])]
        nodes = config.training.nodes
        at = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(_free_port())} if config.training.processes > 1 else {}
        started = [
            subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, **at, "NODE_RANK": str(node)},
            )
            for node in range(nodes)
        ]
        said = [process.communicate(timeout=300) for process in started]
        assert [process.returncode for process in started] == [0] * nodes, said
        assert "".join(out for out, _ in said) == "trained\n", "by the first process alone"

    return run
