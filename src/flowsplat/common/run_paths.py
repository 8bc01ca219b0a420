"""Name the files and folders of a run."""

from __future__ import annotations

from pathlib import Path


class RunPaths:
    """The places in the folder of a run; whether anything is there is another question.

    Attributes:
        path: of the folder.
    """

    def __init__(self, path: Path):
        """Of the folder ``path``."""
        self.path = Path(path)

    @property
    def record_path(self) -> Path:
        """What is finished, and with which settings."""
        return self.path / "run.json"

    @property
    def holds_run(self) -> bool:
        """Whether a run is there, or the runs of the shots of a clip."""
        return self.record_path.exists() or self.shots_record_path.exists()

    @property
    def shots_record_path(self) -> Path:
        """Which shots a clip has, where the folder holds a run of each in place of one of its own."""
        return self.path / "shots.json"

    @property
    def shots_path(self) -> Path:
        """The runs of the shots, each in a folder of its number."""
        return self.path / "shots"

    @property
    def scene_path(self) -> Path:
        """The prepared scene."""
        return self.path / "scene"

    @property
    def training_path(self) -> Path:
        """Checkpoints and history of the training."""
        return self.path / "training"

    @property
    def model_path(self) -> Path:
        """The trained model: what is measured."""
        return self.path / "model"

    @property
    def all_frames_path(self) -> Path:
        """The model that was fitted to the held-out frames, too: what is shown."""
        return self.path / "model_all_frames"

    @property
    def one_color_path(self) -> Path:
        """The model that is shown, fitted without slopes of brightness: what formats with one color a Gaussian get."""
        return self.path / "model_one_color"

    @property
    def static_path(self) -> Path:
        """The static scene that the result is compared with, and its training."""
        return self.path / "static"

    @property
    def coarse(self) -> RunPaths:
        """The coarse scene that a long run begins with, which has a scene, a model and videos of its own."""
        return RunPaths(self.path / "coarse")

    @property
    def logs_path(self) -> Path:
        """For TensorBoard."""
        return self.path / "logs"

    @property
    def preview_path(self) -> Path:
        """An image of the training that goes on."""
        return self.path / "preview.png"

    @property
    def evaluation_path(self) -> Path:
        """Rendered held-out images."""
        return self.path / "evaluation"

    @property
    def metrics_path(self) -> Path:
        """The figures."""
        return self.path / "metrics.json"

    @property
    def renders_path(self) -> Path:
        """Videos."""
        return self.path / "renders"

    @property
    def report_path(self) -> Path:
        """The report of a whole run."""
        return self.path / "report.html"

    @property
    def priors_report_path(self) -> Path:
        """That of its priors."""
        return self.path / "priors.html"
