"""Which of all processes of a training this one is.

With several devices Lightning starts the program again for each further one of its node. On every node it is started
once, with the environment that Lightning, torchrun or SLURM reads.
"""

from __future__ import annotations

from lightning.fabric.plugins.environments import LightningEnvironment, SLURMEnvironment, TorchElasticEnvironment

from erfsfm.config import TrainingConfig


def rank_of(training: TrainingConfig) -> int:
    """Number of this process among those of all nodes, as Lightning will count it."""
    if training.processes == 1:
        return 0
    for started in (TorchElasticEnvironment, SLURMEnvironment):
        if started.detect():
            return int(started().global_rank())
    own = LightningEnvironment()
    return int(own.node_rank() * training.devices + own.local_rank())
