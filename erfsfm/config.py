"""Complete, frozen configuration of an experiment, read from YAML and written beside its results."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from erfsfm.errors import ConfigError

Fidelity = Literal["default", "paper"]


class Section(BaseModel):
    """A part of the configuration: unknown keys are refused, values never change."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class NetworkConfig(Section):
    """Which networks, how wide, how faithful."""

    depth: str = Field(default="depthnet", description="preset of the depth network")
    pose: str = Field(default="posenet", description="preset of the pose network")
    fidelity: Fidelity = Field(default="default", description="'paper' keeps every quirk of the reference code")
    depth_width: float = Field(default=1.0, gt=0, le=4, description="multiplies the depth network's channels")
    pose_width: float = Field(default=1.0, gt=0, le=4, description="multiplies the pose network's channels")
    normalisation: Literal["none", "batch"] = Field(default="none", description="layer after each convolution")
    activation: Literal["relu", "leaky"] = Field(
        default="relu", description="'leaky' lets a narrow decoder learn where all its channels are at rest"
    )
    sources: Literal[2, 4] = Field(default=4, description="frames around the target: snippets have one more")
    masks: bool = Field(default=False, description="explainability masks, the pose network's second head")
    height: int = Field(default=128, ge=32, description="network input, pixels")
    width: int = Field(default=416, ge=32, description="network input, pixels")


class DataConfig(Section):
    """Which recordings, which frames of them, and how samples are varied."""

    roots: list[Path] = Field(default_factory=list, description="data sets; --dataset adds to them")
    ranges: dict[str, str] = Field(
        default_factory=dict, description="frames to train on, e.g. {kitti_odometry/00: '0:250'}; else all"
    )
    exclude: list[str] = Field(
        default_factory=lambda: ["kitti_odometry/03", "kitti_odometry/09", "kitti_odometry/10"],
        description="recordings never trained on, also through the odometry-raw table",
    )
    validation: list[str] = Field(
        default_factory=lambda: ["simulated/500-599"], description="recordings that only validate"
    )
    split: str | None = Field(
        default=None,
        description="file of recordings to train, validate and test on, or its shipped name: configs/splits",
    )
    leave_out: Literal["eigen", "none"] = Field(
        default="eigen", description="KITTI raw drives never trained on: the 28 test scenes of Eigen et al."
    )
    static_frames: Literal["remove", "keep"] = Field(
        default="remove", description="frames of KITTI raw in which the car stands, by GPS/IMU, else by their images"
    )
    weights: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict,
        description="share of samples by prefix of the recording, e.g. {simulated: 1, kitti: 1}; "
        "empty: by number of frames",
    )
    validation_snippets: int = Field(default=60, ge=1, description="snippets looked at in each validation")
    flip: float = Field(default=0.5, ge=0, le=1, description="probability of a mirrored snippet")
    zoom: float = Field(default=1.15, ge=1, le=2, description="largest scale-crop of a snippet, per axis")
    colour_jitter: float = Field(default=0.0, ge=0, le=0.5, description="largest change of brightness, contrast, gamma")
    weather: float = Field(
        default=0.0, ge=0, le=1, description="share of snippets shown blurred, rained on, under other exposures"
    )
    cache_mb: int = Field(default=4000, ge=0, description="memory for decoded images")
    workers: int = Field(default=1, ge=0, description="processes that prepare samples")


class LossConfig(Section):
    """The objective: which terms, with which weights. The defaults are the paper's."""

    photometric_weight: float = Field(default=1.0, ge=0, description="of the photometric error; 0 saves its work")
    ssim_weight: float = Field(default=0.0, ge=0, le=1, description="share of structural dissimilarity; 0 is L1")
    reduction: Literal["mean", "minimum"] = Field(
        default="mean", description="over sources: 'minimum' forgives occlusion (Godard et al. 2019)"
    )
    auto_mask: bool = Field(default=False, description="ignore pixels that a still camera explains better")
    warm_up_steps: int = Field(
        default=0,
        ge=0,
        description="first steps under the paper's plain L1 mean: structure finds no large rotation, and a minimum "
        "teaches the pose network only the source that fits best already",
    )
    scales: int = Field(default=4, ge=1, le=4, description="pyramid levels of the photometric error")
    smoothness: Literal["depth-second-order", "disparity-second-order", "disparity-edge-aware"] = Field(
        default="depth-second-order", description="what is kept smooth, and how"
    )
    smoothness_weight: float = Field(default=0.2, ge=0)
    mask_weight: float = Field(default=0.0, ge=0, description="explainability regularisation; needs network.masks")
    consistency_weight: float = Field(default=0.0, ge=0, description="depth agreement of adjacent frames")


class TeacherConfig(Section):
    """Pull towards what classical two-view geometry measures in the same images, without labels; off by default."""

    rotation_weight: float = Field(
        default=0.0, ge=0, description="of the rotations; measured ones then also warp the images"
    )
    translation_weight: float = Field(default=0.0, ge=0, description="of the translations, in the depth's unit")
    structure_weight: float = Field(default=0.0, ge=0, description="of depth up to a scale per image")
    unit_weight: float = Field(
        default=0.0, ge=0, description="of the depth's unit: heights of the camera over the road"
    )
    alone_steps: int = Field(
        default=0, ge=0, description="first steps without photometric error, half as long: it pulls best from near by"
    )
    cache: Path | None = Field(default=None, description="folder that keeps measurements between runs")

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each term that is wanted."""
        every = {
            "rotation": self.rotation_weight,
            "translation": self.translation_weight,
            "structure": self.structure_weight,
            "unit": self.unit_weight,
        }
        return {name: weight for name, weight in every.items() if weight > 0}


class TrainingConfig(Section):
    """The optimiser and the loop."""

    steps: int = Field(default=200_000, ge=1)
    batch: int = Field(default=4, ge=1, description="snippets a step and device")
    devices: int = Field(
        default=1, ge=1, description="GPUs, or processes on a CPU; batch norm is common to them on GPUs alone"
    )
    networks: Literal["both", "depth"] = Field(
        default="both", description="which of them learn; a pose network that does not keeps its weights"
    )
    optimiser: Literal["adam", "muon"] = Field(
        default="adam", description="muon: orthogonal steps for the kernels, Adam for the rest"
    )
    learning_rate: float = Field(default=2e-4, gt=0)
    kernel_rate: float = Field(default=1.0, gt=0, description="multiple of it for the kernels under muon")
    offset_rate: float = Field(
        default=1.0, gt=0, le=1, description="share of it for what predicts deformable offsets: fast ones run away"
    )
    schedule: Literal["constant", "cosine", "step"] = Field(
        default="constant", description="of the learning rate; step: a tenth in the last quarter"
    )
    gradient_clip: float = Field(default=0.0, ge=0, description="largest gradient norm; 0: not clipped")
    validate_every: int = Field(default=1000, ge=1, description="steps")
    patience: int = Field(default=0, ge=0, description="validations without a better one that end the run; 0: none do")
    checkpoint_every: int = Field(default=500, ge=1, description="steps")
    log_every: int = Field(default=50, ge=1, description="steps")
    precision: Literal["32-true", "bf16-mixed", "16-mixed"] = Field(
        default="32-true", description="of the networks; a CPU takes bf16-mixed for 16-mixed, and says so"
    )
    seed: int = Field(default=0, ge=0)


class ExperimentConfig(Section):
    """One experiment, complete."""

    network: NetworkConfig = Field(default_factory=NetworkConfig)
    data: DataConfig = Field(default_factory=DataConfig)
    loss: LossConfig = Field(default_factory=LossConfig)
    teacher: TeacherConfig = Field(default_factory=TeacherConfig)
    training: TrainingConfig = Field(default_factory=TrainingConfig)
    initial_weights: str | None = Field(
        default=None, description="weights to start from: the same networks, other presets of them, or half as wide"
    )

    @model_validator(mode="after")
    def _masks_exist(self) -> Self:
        if self.loss.mask_weight > 0 and not self.network.masks:
            raise ValueError("loss.mask_weight needs network.masks: true")
        return self


def config_folders() -> list[Path]:
    """Where named configurations lie: in the wheel, or in the source tree."""
    package = Path(__file__).parent
    return [package / "_configs", package.parent / "configs" / "erfsfm"]


def find_config(name_or_path: str) -> Path:
    """The YAML file of a path or a shipped name.

    Raises:
        ConfigError: neither a file nor a known name.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    known: dict[str, Path] = {}
    for folder in config_folders():
        known |= {file.stem: file for file in sorted(folder.glob("*.yaml"))}
    if name_or_path in known:
        return known[name_or_path]
    near = difflib.get_close_matches(name_or_path, known, n=3)
    short = [name for name in sorted(known) if "-" not in name]  # not the rows of the paper's tables
    offered = ", ".join(dict.fromkeys([*near, *short]))
    raise ConfigError(
        f"no configuration '{name_or_path}': it is neither a file nor one of {offered} "
        f"({len(known)} in all, see configs/erfsfm)"
    )


Override = Annotated[str, "section.key=value"]


def load_experiment(name_or_path: str | Path | None, overrides: list[Override] | None = None) -> ExperimentConfig:
    """Read an experiment and apply ``section.key=value`` overrides.

    Raises:
        ConfigError: missing file, bad YAML, unknown key or a value out of bounds; one line.
    """
    tree: dict[str, Any] = {}
    origin = "the defaults"
    if name_or_path is not None:
        path = find_config(str(name_or_path))
        origin = str(path)
        try:
            tree = yaml.safe_load(path.read_text()) or {}
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
        if not isinstance(tree, dict):
            raise ConfigError(f"{path} must hold sections with keys; got {type(tree).__name__}")
    for override in overrides or []:
        _apply_override(tree, override)
    try:
        return ExperimentConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(_explain(error, origin)) from error


def _apply_override(tree: dict[str, Any], override: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise ConfigError(f"--set wants section.key=value; got '{override}'")
    *sections, leaf = key.split(".")
    node = tree
    for section in sections:
        node = node.setdefault(section, {})
        if not isinstance(node, dict):
            raise ConfigError(f"--set {override}: '{section}' is not a section")
    try:
        node[leaf] = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {override}: '{text}' is not a YAML value") from error


def _explain(error: ValidationError, origin: str) -> str:
    """The first problem of a validation error in one line, with the nearest known key."""
    first = error.errors()[0]
    location = [str(part) for part in first["loc"]]
    where = ".".join(location)
    if not location:
        return f"{origin}: {first['msg'].removeprefix('Value error, ')}"
    if first["type"] == "extra_forbidden":
        model: Any = ExperimentConfig
        for part in location[:-1]:
            model = model.model_fields[part].annotation
        known = list(model.model_fields)
        close = difflib.get_close_matches(location[-1], known, n=1)
        hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(known)}"
        return f"unknown key '{where}' in {origin}; {hint}"
    return f"'{where}' in {origin}: {first['msg'].lower()}; got {first['input']!r}"


def dump_yaml(config: BaseModel) -> str:
    """The configuration as YAML that reads back to an equal configuration."""
    text: str = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
    return text
