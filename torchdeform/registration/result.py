"""What a registration returns, and what its callback sees on the way."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from torchdeform.core.diagnostics import Diagnosis
from torchdeform.core.grid import Grid
from torchdeform.core.transform import Affine
from torchdeform.errors import InputError
from torchdeform.metrics.evaluation import Evaluation
from torchdeform.registration.affine.align import Alignment
from torchdeform.registration.evidence import Evidence
from torchdeform.registration.keypoints import Keypoints
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.tissue import TissueOutcome
from torchdeform.registration.verdict import Verdict, judge


@dataclass(frozen=True)
class Progress:
    """One step of the optimisation, handed to the callback.

    Attributes:
        level: pyramid level, 0 is the coarsest.
        levels: number of levels.
        step: step within the level, from 1.
        steps: steps at most on this level.
        similarity: similarity of each item before the step ``(B,)``, higher is better.
        shape: grid of this level.
    """

    level: int
    levels: int
    step: int
    steps: int
    similarity: Tensor
    shape: tuple[int, ...]


Callback = Callable[[Progress], None]


@dataclass(frozen=True)
class LevelRecord:
    """How one pyramid level went.

    Attributes:
        shape: grid of the level.
        similarity: similarity after each step, one ``(B,)`` tensor per step, the first before any step.
        shortened: steps that were shortened because they would have folded, summed over the batch.
        seconds: wall time.
    """

    shape: tuple[int, ...]
    similarity: tuple[Tensor, ...]
    shortened: int
    seconds: float


@dataclass(frozen=True)
class RegistrationResult:
    """The maps, the warped image, and how it went.

    Attributes:
        displacement: u of φ = id + u ``(B, D, *S)`` on the fixed grid, units of spacing, array-axis order. φ takes
            points of the fixed space to the moving space; warped(x) = moving(φ(x)).
        inverse: displacement of φ⁻¹ on the same grid; takes points of the moving space to the fixed space.
        warped: moving image seen through φ ``(B, C, *S)``.
        grid: the fixed grid.
        similarity_before: `mark` of fixed and moving ``(B,)`` in their own place: 1 for equal images, about 0 for
            unrelated ones.
        similarity_after: that of fixed and warped ``(B,)``.
        objective_before: what was maximised where the deformation began, ``(B,)``; higher is better.
        objective_after: the same at the end, over the same voxels.
        diagnosis: determinants and folds of φ.
        inverse_error_mean: mean over x of |φ(φ⁻¹(x)) − x| in voxels ``(B,)``.
        inverse_error_max: its maximum ``(B,)``.
        levels: one record per pyramid level, coarse to fine.
        seconds: wall time per stage.
        settings: the settings used.
        affine: map A of the world that comes after φ: a point x of the fixed space goes to A(φ(x)), and warped(x) =
            moving(A(φ(x))); None for the identity. ``displacement``, ``inverse`` and ``diagnosis`` are of φ alone.
        alignment: how that map was found; None where it was given, or none was asked for.
        evaluation: what labels and landmarks say; None without them.
        similarity_aligned: the mark after the alignment ``(B,)``, over the voxels of ``similarity_after``; None where
            nothing was aligned.
        absent: where the similarity was let go, as nothing corresponds ``(B, 1, *S)``, from 0 to 1; None if nowhere.
        choice: a sentence on the similarity that was chosen; None where it was given.
        evidence: what the images and the map say, of each item.
        tissue: how the labels of the tissue were kept; empty without.
        keypoints: the pairs of points that the start joined, of each item; empty where none were looked for.
        warnings: sentences about what looks wrong with the images.
        unit: what lengths are shown in.
    """

    displacement: Tensor
    inverse: Tensor
    warped: Tensor
    grid: Grid
    similarity_before: Tensor
    similarity_after: Tensor
    objective_before: Tensor
    objective_after: Tensor
    diagnosis: Diagnosis
    inverse_error_mean: Tensor
    inverse_error_max: Tensor
    levels: tuple[LevelRecord, ...]
    seconds: dict[str, float]
    settings: RegistrationSettings
    affine: Affine | None = None
    alignment: Alignment | None = None
    evaluation: Evaluation | None = None
    similarity_aligned: Tensor | None = None
    absent: Tensor | None = None
    choice: str | None = None
    evidence: tuple[Evidence, ...] = ()
    tissue: tuple[TissueOutcome, ...] = ()
    keypoints: tuple[Keypoints, ...] = ()
    warnings: tuple[str, ...] = ()
    unit: str = "px"

    @property
    def verdict(self) -> Verdict:
        """Whether the registration of one pair went well.

        Raises:
            InputError: a batch of several pairs, whose `evidence` can be judged one by one.
        """
        if len(self.evidence) != 1:
            raise InputError(f"verdict: there are {len(self.evidence)} pairs; register them one by one, or judge each")
        return judge(
            self.evidence[0],
            self.grid,
            folds=int(self.diagnosis.folds),
            evaluation=self.evaluation,
            mirror=self.alignment.mirror if self.alignment else 0.0,
            warnings=self.warnings,
            unit=self.unit,
            tissue=self.tissue,
            labels_pulled=self.settings.labels_weight > 0,
        )
