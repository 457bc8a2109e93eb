"""erfsfm-slam as a baseline of VSLAM-LAB; for its folder ``Baselines/baseline_files`` (``docs/evaluation.md``)."""

from __future__ import annotations

from Baselines.BaselineVSLAMLAB import BaselineVSLAMLAB


class ErfsfmBaseline(BaselineVSLAMLAB):  # type: ignore[misc]
    """A checkout in ``Baselines/erfsfm-slam``, installed into the pixi environment ``erfsfm``; one camera, no GPU."""

    def __init__(self, baseline_name: str = "erfsfm", baseline_folder: str = "erfsfm-slam") -> None:
        parameters = {
            "verbose": 1,
            "mode": "mono",
            "weights": "sim",  # saw no real image, so that no sequence was seen in training
            "camera_height_m": "unknown",  # above the road; a number gives metres
            "overrides": "mapping.enabled=false",  # settings, divided by blanks
        }
        super().__init__(baseline_name, baseline_folder, parameters)
        self.color = (0.10, 0.60, 0.45)
        self.modes = ["mono"]
        self.cam_models = ["pinhole", "radtan4", "radtan5", "equid4"]
        self.command_style = "python"

    def is_installed(self) -> tuple[bool, str]:
        """Whether the program is in its environment, and what to say."""
        lab = self.baseline_path.parent.parent
        program = lab / ".pixi" / "envs" / self.baseline_name / "bin" / "erfsfm-slam"
        return (True, "is installed") if program.is_file() else (False, "not installed (auto install available)")
