"""Trainings in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from erfsfm.config import ExperimentConfig, dump_yaml


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
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "trained\n", "by the first process alone"

    return run
