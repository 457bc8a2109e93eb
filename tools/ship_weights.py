"""Turn a training output into shipped weights: half precision, with a model card.

Example: python tools/ship_weights.py runs/sim sim --data "60 simulated worlds, seeds 0-59"
"""

from __future__ import annotations

import json
from pathlib import Path

from shared.command import one_line_errors, parser_of

from erfsfm.checkpoint import Model, load_model, save_model
from erfsfm.common.readers.frame_range import merge
from erfsfm.common.table import table_of
from erfsfm.model_record import SHIPPED, tensors_file

LARGEST_MB = 20

CARD = """# Weights `{name}`

| | |
|---|---|
| networks | `{depth}` at width {depth_width}, `{pose}` at width {pose_width}, normalisation {normalisation} |
| input | {width}x{height}, snippets of {frames} frames |
| data | {data} |
| seen | {seen} |
| held out | {held_out} |
| steps | {steps} |
| command | `{command}` |
| commit | {commit} |
| licence | {licence} |

{note}

Depth and poses share one unit, about ten camera heights.

Measured (`{evaluation}`):

{metrics}
"""


@one_line_errors()
def main() -> None:
    """Write ``erfsfm/weights/NAME``."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("run", type=Path, help="output folder of erfsfm train")
    add("name", help="name of the shipped weights")
    add(
        "--mean-with", action="append", default=[], help="weights to average with the run's; repeat"
    )
    add("--data", required=True, help="one line: what it was trained on")
    add("--held-out", default="simulated seeds 500-599", help="one line: what it never saw")
    add("--command", help="in place of the recorded one, without the paths of one machine")
    add("--note", required=True, help="a paragraph for the card: what taught each network, and how")
    add("--metrics", type=Path, help="output of erfsfm evaluate ... --json")
    add(
        "--evaluation",
        default="validation of the training run",
        help="the command behind --metrics",
    )
    arguments = parser.parse_args()

    model = averaged([load_model(each) for each in (arguments.run, *arguments.mean_with)])
    folder = SHIPPED / arguments.name
    record = model.record.model_copy(update={"command": arguments.command or model.record.command})
    save_model(folder, Model(record, model.networks), half=True)
    for file in (tensors_file(folder, kind) for kind in record.kinds):
        size = file.stat().st_size / 1e6
        if size > LARGEST_MB:
            raise SystemExit(
                f"{file.name} has {size:.1f} MB; shipped weights have at most {LARGEST_MB}: train narrower"
            )
    network = record.network
    measured = json.loads(arguments.metrics.read_text()) if arguments.metrics else [record.metrics]
    card = CARD.format(
        name=arguments.name,
        **network.model_dump(),
        frames=network.sources + 1,
        data=arguments.data,
        seen=", ".join(record.trained_on),
        held_out=arguments.held_out,
        steps=record.step,
        command=record.command,
        commit=record.commit,
        licence=record.licence,
        note=arguments.note,
        evaluation=arguments.evaluation,
        metrics=table_of(measured).markdown(),
    )
    (folder / "README.md").write_text(card)
    print(f"{folder}: read {folder / 'README.md'}")


def averaged(models: list[Model]) -> Model:
    """The first, whose networks have the mean of the weights of all (Wortsman et al. 2022, model soups)."""
    model = models[0]
    for kind, network in model.networks.items():
        states = [each.networks[kind].state_dict() for each in models]
        mean = {
            k: sum(each[k] for each in states) / len(states) if v.is_floating_point() else v
            for k, v in states[0].items()
        }
        network.load_state_dict(mean)
    seen = merge([name for each in models for name in each.record.trained_on])
    return Model(model.record.model_copy(update={"trained_on": seen}), model.networks)


if __name__ == "__main__":
    main()
