"""Complete, frozen configuration of an experiment, read from YAML and written beside its results."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from erfsfm.common import config_tree
from erfsfm.common.config_tree import Section
from erfsfm.common.config_tree import dump_yaml as dump_yaml

Fidelity = Literal["default", "paper"]
NetworkKind = Literal["depth", "pose"]
TrainedNetworks = Literal["both", "depth", "pose"]
Precision = Literal["32-true", "bf16-mixed", "16-mixed"]
EIGEN = "eigen"  # names the test scenes of Eigen et al., and the shipped split with their frames
UNTRAINED = ("imagenet", "none")  # initial weights that no training of ours wrote


class NetworkConfig(Section):
    """Presets of the networks, their widths and their fidelity to the paper."""

    depth: str = Field(
        default="depthnet", description="preset of the depth network, see erfsfm networks"
    )
    pose: str = Field(
        default="posenet", description="preset of the pose network, see erfsfm networks"
    )
    fidelity: Fidelity = Field(
        default="default",
        description="paper: layers, intrinsics and photometric error of the reference code",
    )
    depth_width: float = Field(
        default=1.0, gt=0, le=4, description="factor on the depth network's channels"
    )
    pose_width: float = Field(
        default=1.0, gt=0, le=4, description="factor on the pose network's channels"
    )
    normalisation: Literal["none", "batch"] = Field(
        default="none", description="normalisation layer after each convolution"
    )
    activation: Literal["relu", "leaky"] = Field(
        default="relu",
        description="leaky: leaky ReLU, for narrow decoders in which all ReLUs may die",
    )
    sources: Literal[2, 4] = Field(
        default=4, description="source frames of a snippet; with the target it has one more"
    )
    alignment: Literal["none", "images"] = Field(
        default="none",
        description="images: rotations and the direction of travel that the pose network guesses are measured in them",
    )
    height: int = Field(
        default=128, ge=32, le=4096, description="height of the network input, pixels"
    )
    width: int = Field(
        default=416, ge=32, le=4096, description="width of the network input, pixels"
    )


class DataConfig(Section):
    """Data sets, the frames of them to use, and data augmentation."""

    roots: list[Path] = Field(default_factory=list, description="data sets; --dataset adds to them")
    ranges: dict[str, str] = Field(
        default_factory=dict,
        description="frames to train on by recording, e.g. {kitti_odometry/00: '0:250'}; empty: all",
    )
    exclude: list[str] = Field(
        default_factory=lambda: [
            "kitti_odometry/03",
            "kitti_odometry/09",
            "kitti_odometry/10",
            EIGEN,
        ],
        description="recordings or frames never trained on, also where a KITTI raw drive holds the same frames; eigen: "
        "the 28 test scenes of Eigen et al. among KITTI raw drives",
    )
    validation: list[str] = Field(
        default_factory=lambda: ["simulated/500-599"],
        description="recordings or frames (kitti_odometry/00[290:300]) used for validation alone; named ones must be "
        "among the data",
    )
    validation_share: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="last part of each recording that is used for validation alone",
    )
    split: str | None = Field(
        default=None,
        description="file of the recordings to train, validate and test on, or the name of one in configs/splits",
    )
    weights: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict,
        description="relative number of samples by prefix of the recording, e.g. {simulated: 1, kitti: 1}; "
        "empty: by number of frames",
    )
    flip: float = Field(default=0.5, ge=0, le=1, description="probability of a horizontal flip")
    zoom: float = Field(
        default=1.15,
        ge=1,
        le=2,
        description="largest factor of random scaling and cropping, per axis",
    )
    roll: float = Field(
        default=0.0,
        ge=0,
        le=30,
        description="largest roll of the camera in labelled single images, degrees",
    )
    colour_jitter: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="largest relative change of brightness, contrast, gamma",
    )
    weather: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="probability of simulated blur, rain and exposure changes in a snippet",
    )
    exact: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="share of each batch that is single images of simulated worlds with their true depth as the label "
        "(simulate --depth); such worlds are then used for nothing else",
    )
    cache_mb: int = Field(
        default=4000, ge=0, description="memory for decoded images and labels, MB per process"
    )
    workers: int = Field(
        default=1, ge=0, le=128, description="data loader processes; 0: in the training process"
    )


class LossConfig(Section):
    """Terms of the objective and their weights; the defaults are the paper's."""

    photometric_weight: float = Field(
        default=1.0, ge=0, description="weight of the photometric error; 0: not computed"
    )
    ssim_weight: float = Field(
        default=0.0, ge=0, le=1, description="weight of SSIM in the photometric error; 0: L1 alone"
    )
    reduction: Literal["mean", "minimum"] = Field(
        default="mean",
        description="over source frames; minimum tolerates occlusion, and masks pixels whose error is smaller without "
        "warping (Godard et al. 2019)",
    )
    smoothness: Literal["depth-second-order", "disparity-edge-aware"] = Field(
        default="depth-second-order", description="smoothed quantity and order of its derivative"
    )
    smoothness_weight: float = Field(default=0.2, ge=0, description="weight of the smoothness term")


class TeacherConfig(Section):
    """Labels: the truth of simulated worlds, classical geometry of the same images, another network; off by default."""

    views: Literal["exact", "many", "network"] = Field(
        default="exact",
        description="exact: true depth and poses of simulated worlds; many: poses by the SLAM system, learned depth "
        "refined by neighbours; network: the depth of the network of slam_weights, which is imitated",
    )
    stride: int = Field(
        default=2, ge=1, description="every how many frames a label is measured under many views"
    )
    slam_weights: str = Field(
        default="sim",
        description="weights of the SLAM system that gives the poses, or of the imitated network",
    )
    rotation_weight: float = Field(default=0.0, ge=0, description="weight of the rotation error")
    translation_weight: float = Field(
        default=0.0, ge=0, description="weight of the translation error, in the depth's unit"
    )
    structure_weight: float = Field(default=0.0, ge=0, description="weight of the depth error")
    edge_weight: float = Field(
        default=0.0,
        ge=0,
        description="weight of the error of the inverse depth's steps between pixels",
    )
    cache: Path | None = Field(
        default=None, description="folder that keeps what many views measured; else OUTPUT/teacher"
    )

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each term that is switched on."""
        every = {
            "rotation": self.rotation_weight,
            "translation": self.translation_weight,
            "structure": self.structure_weight,
            "edge": self.edge_weight,
        }
        return {name: weight for name, weight in every.items() if weight > 0}

    @property
    def exact(self) -> bool:
        """Whether every label is the truth of a simulated world."""
        return self.views == "exact" and bool(self.weights)

    @property
    def gives_motion(self) -> bool:
        """Whether labels hold the motion, which then warps the images."""
        return self.views != "network" and bool(self.weights)


class TrainingConfig(Section):
    """The optimiser and the loop."""

    steps: int = Field(default=200_000, ge=1, description="optimisation steps")
    minutes: float = Field(
        default=0.0,
        ge=0,
        description="longest time of the loop, earlier parts of a resumed run included; the schedule follows steps or "
        "time, whichever is farther; 0: no limit",
    )
    batch: int = Field(default=4, ge=1, le=1024, description="snippets per step and device")
    devices: int = Field(
        default=1,
        ge=1,
        description="GPUs, or processes on the CPU; batch normalisation is synchronised on GPUs alone",
    )
    networks: TrainedNetworks = Field(
        default="both",
        description="trained networks; the other one keeps its initial weights, and is not written without any",
    )
    frozen_stages: int = Field(
        default=0,
        ge=0,
        le=7,
        description="first stages of a lite0 encoder that keep their weights, the stem being one",
    )
    learning_rate: float = Field(default=2e-4, gt=0, description="of Adam")
    offset_rate: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="factor on the learning rate of deformable offsets, which may diverge",
    )
    encoder_rate: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="factor on the learning rate of a lite0 encoder, which is pretrained",
    )
    schedule: Literal["constant", "cosine"] = Field(
        default="constant", description="of the learning rate"
    )
    average_decay: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="of the moving average of the weights at every step, which is validated and written; 0: none",
    )
    gradient_clip: float = Field(
        default=0.0, ge=0, description="largest gradient norm; 0: no clipping"
    )
    validate_every: int = Field(default=1000, ge=1, description="steps between validations")
    checkpoint_every: int = Field(default=500, ge=1, description="steps between checkpoints")
    precision: Precision = Field(
        default="32-true",
        description="of the networks; a CPU uses bf16-mixed in place of 16-mixed, and 32-true if it has no bfloat16, "
        "with a warning",
    )
    seed: int = Field(
        default=0, ge=0, le=2**31 - 1, description="of initial weights, snippets and augmentation"
    )

    def of_batch(self, share: float) -> int:
        """Samples of a batch that a share comes to, rounded down."""
        return int(share * self.batch)


class ExperimentConfig(Section):
    """One complete experiment."""

    network: NetworkConfig = Field(default_factory=NetworkConfig)
    data: DataConfig = Field(default_factory=DataConfig)
    loss: LossConfig = Field(default_factory=LossConfig)
    teacher: TeacherConfig = Field(default_factory=TeacherConfig)
    training: TrainingConfig = Field(default_factory=TrainingConfig)
    initial_weights: str = Field(
        default="imagenet",
        description="weights to start from, whose presets may differ; imagenet: the encoder of a lite0 network alone, "
        "where depth is not among the weights; none: nothing",
    )

    def with_roots(self, roots: Sequence[Path]) -> Self:
        """The same experiment on further data sets."""
        data = self.data.model_copy(update={"roots": [*self.data.roots, *roots]})
        return self.model_copy(update={"data": data})

    @property
    def single_images(self) -> bool:
        """Whether labels of depth are all that is learned from, so that a sample needs no other view."""
        by_images = self.loss.photometric_weight + self.loss.smoothness_weight > 0
        return (
            self.training.networks == "depth"
            and self.teacher.structure_weight > 0
            and not by_images
        )

    @model_validator(mode="after")
    def _parts_agree(self) -> Self:
        if self.data.exact > 0 and (
            self.teacher.views == "exact" or self.teacher.structure_weight == 0
        ):
            raise ValueError(
                "data.exact needs teacher.views: many or network, the labels of the rest of each batch, and a "
                "teacher.structure_weight above 0"
            )
        if self.data.exact > 0 and self.training.of_batch(self.data.exact) == 0:
            raise ValueError(
                f"data.exact: {self.data.exact:g} of a batch of {self.training.batch} is less than one sample: set "
                f"data.exact={1 / self.training.batch:g} or more, or a larger training.batch"
            )
        by_motion = self.training.networks != "depth" or self.loss.photometric_weight > 0
        if self.teacher.views == "network" and (by_motion or self.teacher.structure_weight == 0):
            raise ValueError(
                "teacher.views: network teaches depth alone: set training.networks=depth, loss.photometric_weight=0 "
                "and a teacher.structure_weight above 0"
            )
        if self.training.networks == "pose" and not self.teacher.gives_motion:
            raise ValueError(
                "training.networks: pose needs teacher.views: exact or many, which know the motion without depth, and "
                "a teacher.rotation_weight or teacher.translation_weight above 0"
            )
        if self.training.minutes > 0 and self.training.devices > 1:
            raise ValueError(
                "training.minutes needs training.devices: 1: the clocks of several would differ"
            )
        return self


def config_folders() -> list[Path]:
    """Folders of the named configurations: in the wheel, or in the source tree."""
    package = Path(__file__).resolve().parent
    return [package / "_configs", package.parent / "configs" / "erfsfm"]


def load_experiment(
    file_or_name: str | Path | None, overrides: Sequence[str] = ()
) -> ExperimentConfig:
    """Read an experiment and apply ``section.key=value`` overrides; None for the defaults.

    Raises:
        ConfigError: missing file, bad YAML, unknown key or a value out of bounds; one line.
    """
    return config_tree.load_config(ExperimentConfig, file_or_name, overrides, config_folders())
