"""Turn a training output into shipped weights: half precision, with a model card.

Example: python tools/ship_weights.py runs/sim sim --data "60 simulated worlds, seeds 0-59"
"""

from __future__ import annotations

from pathlib import Path

from shared.command import markdown, one_line_errors, parser_of

from erfsfm.checkpoint import load_model, save_model
from erfsfm.model_record import FILES, SHIPPED

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

Trained without labels, from images and intrinsics alone. Depth and poses share one unit, about ten camera heights.

Measured by the validation of the training:

{metrics}
"""


@one_line_errors()
def main() -> None:
    """Write ``erfsfm/weights/NAME``."""
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path, help="output folder of erfsfm train")
    parser.add_argument("name", help="name of the shipped weights")
    parser.add_argument("--data", required=True, help="one line: what it was trained on")
    parser.add_argument("--held-out", default="simulated seeds 500-599", help="one line: what it never saw")
    arguments = parser.parse_args()

    model = load_model(arguments.run)
    folder = SHIPPED / arguments.name
    save_model(folder, model, half=True)
    for file in FILES:
        size = (folder / file).stat().st_size / 1e6
        if size > LARGEST_MB:
            raise SystemExit(f"{file} has {size:.1f} MB; shipped weights have at most {LARGEST_MB}: train narrower")
    record = model.record
    card = CARD.format(
        name=arguments.name,
        **record.network.model_dump(),
        **record.model_dump(include={"command", "commit", "licence"}),
        **{"data": arguments.data, "seen": ", ".join(record.trained_on), "held_out": arguments.held_out},
        **{"frames": record.network.sources + 1, "steps": record.step},
        metrics=markdown(list(record.metrics), [[f"{value:.4f}" for value in record.metrics.values()]]),
    )
    (folder / "README.md").write_text(card)
    print(f"{folder}: read {folder / 'README.md'}, and say what else is to be known")


if __name__ == "__main__":
    main()
