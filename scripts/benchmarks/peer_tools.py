"""The tools that `peers.py` sets side by side: what each imports, and how it gets from two files to a map on disk.

Nothing is imported here but the standard library, so that a tool's start-up is its own. `Tool.register` does what is
timed and returns a function that tells, untimed, where the map takes the fixed voxels: by the tool's own resampler,
which is handed images whose values are the coordinates of the moving space, or by the displacement field it wrote.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import SimpleITK as sitk
    from numpy.typing import NDArray

_REACH = 0.5  # the images of coordinates reach this share of the moving image beyond its sides
ELASTIX_RIGID = "rigid.nii"  # the file in a job's folder that says where elastix_rigid wants a rigid map
_FAR = 1e6  # the coordinate of what lies beyond them


@dataclass(frozen=True)
class Job:
    """What a tool is given.

    Attributes:
        fixed: an image of one channel, float32, NIfTI without compression.
        moving: another.
        folder: to write into.
        fixed_mask: where the fixed image counts, or None.
        moving_mask: where the moving image counts, or None.
        device: ``cpu`` or ``cuda``, for the tools that can choose.
        threads: how many a tool may use.
    """

    fixed: Path
    moving: Path
    folder: Path
    fixed_mask: Path | None = None
    moving_mask: Path | None = None
    device: str = "cpu"
    threads: int = 2

    @property
    def names(self) -> tuple[str, str]:
        """The two images."""
        return str(self.fixed), str(self.moving)

    @property
    def masks(self) -> tuple[str, str] | None:
        """The two masks, if both are given."""
        return (str(self.fixed_mask), str(self.moving_mask)) if self.fixed_mask and self.moving_mask else None

    def frame(self) -> sitk.Image:
        """Return the fixed image."""
        return import_module("SimpleITK").ReadImage(str(self.fixed))


Mapped = Callable[[], "NDArray[np.float64]"]


@dataclass(frozen=True)
class Tool:
    """A tool with settings.

    Attributes:
        package: the distribution whose version is reported.
        imports: modules that are loaded before the clock starts.
        settings: what is chosen, in words.
        register: from files to a map on disk; returns what tells ``(*S, D)`` positions in the moving world.
    """

    package: str
    imports: tuple[str, ...]
    settings: str
    register: Callable[[Job], Mapped]


def by_resampling(job: Job, resample: Callable[[Path], sitk.Image]) -> NDArray[np.float64]:
    """Return where a tool's resampler takes its values from: it resamples the coordinates of the moving space."""
    import numpy as np
    import SimpleITK as sitk

    moved = []
    for k, image in enumerate(_coordinates(sitk.ReadImage(str(job.moving)))):
        source = job.folder / f"coordinate{k}.nii"
        sitk.WriteImage(image, str(source))
        moved.append(sitk.GetArrayFromImage(resample(source)))
    return np.stack(moved, axis=-1).astype(np.float64)


def _coordinates(moving: sitk.Image) -> list[sitk.Image]:
    """Return images of the world's x, y (and z) on a coarse grid that reaches beyond the moving image."""
    import numpy as np
    import SimpleITK as sitk

    size, nodes = np.array(moving.GetSize(), dtype=float), 33
    spacing = (1 + 2 * _REACH) * size / (nodes - 1) * moving.GetSpacing()
    origin = moving.TransformContinuousIndexToPhysicalPoint((-_REACH * size).tolist())
    place = [nodes] * len(size), origin, spacing.tolist(), moving.GetDirection()
    points = sitk.PhysicalPointSource(sitk.sitkVectorFloat32, *place)
    return [sitk.VectorIndexSelectionCast(points, k) for k in range(len(size))]


def by_displacement(job: Job, displacement: NDArray[Any] | None = None) -> NDArray[np.float64]:
    """Return x + d(x) for a displacement ``(*S, D)`` in world units on the fixed grid, x if there is none."""
    import numpy as np
    import SimpleITK as sitk

    fixed = job.frame()
    place = fixed.GetSize(), fixed.GetOrigin(), fixed.GetSpacing(), fixed.GetDirection()
    here = sitk.GetArrayFromImage(sitk.PhysicalPointSource(sitk.sitkVectorFloat64, *place))
    return here if displacement is None else here + np.asarray(displacement, dtype=np.float64)


def _stay(job: Job) -> Mapped:
    return lambda: by_displacement(job)


def _torchdeform(preset: str) -> Tool:
    def register(job: Job) -> Mapped:
        import torchdeform as td

        fixed, moving = (td.read_image(name) for name in job.names)
        masks = [None, None] if job.masks is None else [td.read_image(name).to(job.device) for name in job.masks]
        annotations = td.Annotations(fixed_mask=masks[0], moving_mask=masks[1])
        settings = td.load_settings(preset)
        result = td.register(fixed.to(job.device), moving.to(job.device), settings, annotations=annotations)
        transform = td.Transform.from_displacement(
            result.displacement.cpu(), fixed, affine=result.affine, moving=moving
        )
        td.write_transform(transform, job.folder / "transform.h5")
        return lambda: _itk_transform(job, job.folder / "transform.h5")

    ours = ("torchdeform", "torchdeform.pipeline.register", "torchdeform.registration.deformable")
    needs = (*ours, "SimpleITK", "pydantic", "pydantic.dataclasses", "pydantic.type_adapter", "yaml")
    return Tool("torchdeform", needs, f"preset {preset}: alignment and deformation", register)


def _itk_transform(job: Job, path: Path) -> NDArray[np.float64]:
    import SimpleITK as sitk

    filter_ = sitk.TransformToDisplacementFieldFilter()
    filter_.SetReferenceImage(job.frame())
    filter_.SetOutputPixelType(sitk.sitkVectorFloat64)
    return by_displacement(job, sitk.GetArrayFromImage(filter_.Execute(sitk.ReadTransform(str(path)))))


def _ants(kind: str) -> Tool:
    def register(job: Job) -> Mapped:
        ants, sitk = import_module("ants"), import_module("SimpleITK")
        fixed, moving = (ants.image_read(name) for name in job.names)
        masks = {}
        if job.masks:
            both = [ants.image_read(name) for name in job.masks]
            masks = {"mask": both[0], "moving_mask": both[1], "mask_all_stages": True}
        found = ants.registration(fixed, moving, kind, outprefix=str(job.folder / "ants_"), **masks)

        def resample(source: Path) -> Any:
            image = ants.image_read(str(source))
            out = ants.apply_transforms(fixed, image, found["fwdtransforms"], defaultvalue=_FAR)
            ants.image_write(out, str(job.folder / "out.nii"))
            return sitk.ReadImage(str(job.folder / "out.nii"), sitk.sitkFloat32)

        return lambda: by_resampling(job, resample)

    return Tool("antspyx", ("ants", "SimpleITK"), f"ants.registration, type_of_transform {kind}", register)


@dataclass(frozen=True)
class _Greedy:
    """Greedy's two stages.

    Attributes:
        affine_metric: of the affine stage, ``-n 100x50x10``.
        metric: of the deformable stage, ``-n 100x50x20``.
        options: for it.
        moments: order of the moments that are matched first; 0 for the centres of the images.
    """

    affine_metric: str
    metric: str
    options: str = ""
    moments: int = 0

    def tool(self) -> Tool:
        start = f"-moments {self.moments}" if self.moments else "-ia-image-centers"
        affine = f"affine -dof 12 -m {self.affine_metric} -n 100x50x10"
        words = f"{start}, {affine}, -m {self.metric} -n 100x50x20 {self.options}".strip()
        return Tool("picsl_greedy", ("picsl_greedy", "SimpleITK"), words, self.register)

    def register(self, job: Job) -> Mapped:
        pair = greedy_inputs(job)
        affine, warp = greedy_affine(job, self.affine_metric, self.moments), job.folder / "warp.nii"
        greedy(job, f"-m {self.metric} -n 100x50x20 {self.options} {pair} -it {affine} -o {warp}")

        def resample(source: Path) -> Any:
            sitk, target = import_module("SimpleITK"), job.folder / "out.nii"
            greedy(job, f"-rf {job.fixed} -rb {_FAR} -rm {source} {target} -r {warp} {affine}")
            return sitk.ReadImage(str(target), sitk.sitkFloat32)

        return lambda: by_resampling(job, resample)


def greedy(job: Job, command: str) -> None:
    """Run a command of greedy."""
    picsl_greedy = import_module("picsl_greedy")
    dim = _dimension(job)
    {2: picsl_greedy.Greedy2D, 3: picsl_greedy.Greedy3D}[dim]().execute(f"{command} -threads {job.threads}")


def greedy_inputs(job: Job) -> str:
    """Return the options that name images and masks."""
    masks = f" -gm {job.masks[0]} -mm {job.masks[1]}" if job.masks else ""
    return f"-i {job.fixed} {job.moving}{masks}"


def greedy_affine(job: Job, metric: str, moments: int) -> Path:
    """Align and return the file of the matrix."""
    pair, affine, start = greedy_inputs(job), job.folder / "affine.mat", "-ia-image-centers"
    if moments:
        start = f"-ia {job.folder / 'moments.mat'}"
        greedy(job, f"-moments {moments} -i {job.fixed} {job.moving} -o {job.folder / 'moments.mat'}")
    greedy(job, f"-a -dof 12 -m {metric} -n 100x50x10 {pair} {start} -o {affine}")
    return affine


def _dimension(job: Job) -> int:
    sitk = import_module("SimpleITK")
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(job.fixed))
    reader.ReadImageInformation()
    return reader.GetDimension()


def _elastix(job: Job, extra: Callable[[Job], dict[str, list[str]]] = lambda _: {}) -> Mapped:
    """Register with the default parameter maps; ``extra`` are entries for that of the B-splines."""
    itk = import_module("itk")
    fixed, moving = (itk.imread(name, itk.F) for name in job.names)
    parameters = itk.ParameterObject.New()
    for kind in ("affine", "bspline"):
        choice = parameters.GetDefaultParameterMap(kind, 4, 10.0 * min(fixed.GetSpacing()))
        choice["WriteResultImage"], choice["ErodeMask"] = ["false"], ["false"]
        choice["AutomaticTransformInitialization"] = ["true"]
        choice["AutomaticTransformInitializationMethod"] = ["CenterOfGravity"]
        for key, values in (extra(job) if kind == "bspline" else {}).items():
            choice[key] = values
        parameters.AddParameterMap(choice)
    method = itk.ElastixRegistrationMethod.New(fixed, moving)
    if job.masks:
        first, second = (itk.imread(name, itk.UC) for name in job.masks)
        method.SetFixedMask(first)
        method.SetMovingMask(second)
    method.SetParameterObject(parameters)
    method.SetOutputDirectory(str(job.folder))
    method.UpdateLargestPossibleRegion()
    found = method.GetTransformParameterObject()

    def displacement() -> NDArray[np.float64]:
        field = itk.transformix_deformation_field(moving, found)
        return by_displacement(job, itk.array_from_image(field))

    return displacement


def _rigidity(job: Job) -> dict[str, list[str]]:
    """Return elastix' rigidity penalty, weighted as in its own example, on the voxels of a file."""
    return {
        "Registration": ["MultiMetricMultiResolutionRegistration"],
        "Metric": ["AdvancedMattesMutualInformation", "TransformRigidityPenalty"],
        "Metric0Weight": ["1.0"],
        "Metric1Weight": ["4.0"],
        "LinearityConditionWeight": ["10.0"],
        "OrthonormalityConditionWeight": ["1.0"],
        "PropernessConditionWeight": ["2.0"],
        "UseFixedRigidityImage": ["true"],
        "UseMovingRigidityImage": ["false"],
        "FixedRigidityImageName": [str(job.folder / ELASTIX_RIGID)],
    }


def _dipy(job: Job) -> Mapped:
    import numpy as np

    imwarp, metrics = import_module("dipy.align.imwarp"), import_module("dipy.align.metrics")
    still, place = _nibabel(job.fixed)
    other, other_place = _nibabel(job.moving)
    masks = [None, None] if job.masks is None else [_nibabel(Path(name))[0].astype(np.int32) for name in job.masks]
    start = _dipy_affine((still, place), (other, other_place), masks)
    # Those of its tutorials in two and in three dimensions.
    sigma, steps = {2: (3.0, [100, 50, 25]), 3: (2.0, [10, 10, 5])}[still.ndim]
    method = imwarp.SymmetricDiffeomorphicRegistration(
        metrics.CCMetric(still.ndim, sigma_diff=sigma, radius=4), level_iters=steps
    )
    mapping = method.optimize(still, other, static_grid2world=place, moving_grid2world=other_place, prealign=start)
    np.savez(job.folder / "map.npz", forward=mapping.forward, prealign=start)

    def resample(source: Path) -> sitk.Image:
        import SimpleITK as sitk

        image, own = _nibabel(source)
        out = mapping.transform(image.astype(np.float32), image_world2grid=np.linalg.inv(own))
        return sitk.GetImageFromArray(np.ascontiguousarray(np.asarray(out).T))

    return lambda: by_resampling(job, resample)


def _dipy_affine(fixed: tuple[Any, Any], moving: tuple[Any, Any], masks: list[Any]) -> NDArray[np.float64]:
    """Return what its `affine_registration` finds, which takes three dimensions only: mass, shift, rigid, affine."""
    imaffine, transforms = import_module("dipy.align.imaffine"), import_module("dipy.align.transforms")
    (still, place), (other, other_place) = fixed, moving
    seen = [image if mask is None else image * mask for image, mask in zip((still, other), masks, strict=True)]
    matrix = imaffine.transform_centers_of_mass(seen[0], place, seen[1], other_place).affine
    method = imaffine.AffineRegistration(
        metric=imaffine.MutualInformationMetric(nbins=32),
        level_iters=[10000, 1000, 100],
        sigmas=[3.0, 1.0, 0.0],
        factors=[4, 2, 1],
        verbosity=0,
    )
    for kind in ("Translation", "Rigid", "Affine"):
        transform = getattr(transforms, f"{kind}Transform{still.ndim}D")()
        places = {"static_grid2world": place, "moving_grid2world": other_place, "starting_affine": matrix}
        masked = {"static_mask": masks[0], "moving_mask": masks[1]}
        matrix = method.optimize(still, other, transform, None, **places, **masked).affine
    return matrix


def _nibabel(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return an image as DIPY takes it, and its matrix."""
    import numpy as np

    image = import_module("nibabel").load(path)
    shape = image.header.get_data_shape()
    used = [*range(len(shape)), 3]
    return image.get_fdata(), np.asarray(image.affine)[np.ix_(used, used)]


def _convex_adam(job: Job) -> Mapped:
    import numpy as np
    import SimpleITK as sitk
    import torch

    if _dimension(job) != 3:
        raise ValueError("ConvexAdam takes volumes only")
    to_moving = _world_affine(greedy_affine(job, "NCC 2x2x2", 0))
    fixed, moving = (sitk.ReadImage(name, sitk.sitkFloat32) for name in job.names)
    # With masks it takes even sizes only.
    frame = sitk.ZeroFluxNeumannPad(fixed, [0] * 3, [n % 2 if job.masks else 0 for n in fixed.GetSize()])
    aligned = sitk.Resample(moving, frame, to_moving, sitk.sitkLinear, 0.0)
    arrays = (sitk.GetArrayFromImage(image) for image in (frame, aligned))
    convex = import_module("convexAdam.convex_adam_MIND")
    choices = _convex_adam_masks(job, frame, to_moving)
    found = convex.convex_adam_pt(*arrays, device=torch.device(job.device), dtype=torch.float32, **choices)
    found = found[tuple(slice(n) for n in fixed.GetSize()[::-1])]
    np.save(job.folder / "displacement.npy", found)

    def positions() -> NDArray[np.float64]:
        direction = np.array(fixed.GetDirection()).reshape(3, 3)
        here = by_displacement(job, found[..., ::-1] * fixed.GetSpacing() @ direction.T)
        return here @ np.array(to_moving.GetMatrix()).reshape(3, 3).T + to_moving.GetTranslation()

    return positions


def _convex_adam_masks(job: Job, frame: sitk.Image, to_moving: sitk.AffineTransform) -> dict[str, Any]:
    """Write both masks on the frame, with the axes of SimpleITK's arrays, and return the choices that name them."""
    import numpy as np
    import SimpleITK as sitk

    nibabel, paths = import_module("nibabel"), []
    if job.masks is None:
        return {}
    for k, transform in enumerate((sitk.Transform(3, sitk.sitkIdentity), to_moving)):
        mask = sitk.Resample(sitk.ReadImage(job.masks[k]), frame, transform, sitk.sitkNearestNeighbor, 0)
        paths.append(job.folder / f"mask{k}.nii")
        nibabel.save(nibabel.Nifti1Image(sitk.GetArrayFromImage(mask).astype(np.float32), np.eye(4)), paths[-1])
    return {"use_mask": True, "path_fixed_mask": paths[0], "path_moving_mask": paths[1]}


def _world_affine(path: Path) -> sitk.AffineTransform:
    """Return greedy's matrix, which goes from fixed to moving with x and y reversed, as a transform of ITK."""
    import numpy as np
    import SimpleITK as sitk

    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    matrix = flip @ np.loadtxt(path) @ flip
    transform = sitk.AffineTransform(3)
    transform.SetMatrix(matrix[:3, :3].ravel().tolist())
    transform.SetTranslation(matrix[:3, 3].tolist())
    return transform


def _fireants(job: Job) -> Mapped:
    io, affines, greedies = (import_module(name) for name in _FIREANTS_MODULES)
    fixed, moving = (io.BatchedImages([io.Image.load_file(name, device=job.device)]) for name in job.names)
    affine = affines.AffineRegistration(
        [4, 2, 1], [200, 100, 50], fixed, moving, optimizer="Adam", optimizer_lr=3e-3, cc_kernel_size=5
    )
    affine.optimize()
    method = greedies.GreedyRegistration(
        scales=[4, 2, 1],
        iterations=[200, 100, 25],
        fixed_images=fixed,
        moving_images=moving,
        cc_kernel_size=5,
        deformation_type="compositive",
        smooth_grad_sigma=1,
        optimizer="adam",
        optimizer_lr=0.5,
        init_affine=affine.get_affine_matrix().detach(),
    )
    method.optimize()
    path = str(job.folder / "warp.nii.gz")
    method.save_as_ants_transforms(path)

    def positions() -> NDArray[np.float64]:
        sitk = import_module("SimpleITK")
        return by_displacement(job, sitk.GetArrayFromImage(sitk.ReadImage(path)))

    return positions


_DIPY = (
    "centre of mass, translation, rigid, affine (MI, 32 bins, 10000, 1000, 100 iterations); then "
    "SymmetricDiffeomorphicRegistration with CCMetric of radius 4: in 3D 10, 10, 5 steps, in 2D 100, 50, 25 and sigma 3"
)
_ELASTIX = (
    "default parameter maps affine and bspline, four resolutions, 10 voxels between the last control points, "
    "started at the centres of gravity"
)
_RIGIDITY = "as elastix, with TransformRigidityPenalty of weight 4 on the voxels of rigid.nii"
_CONVEX = "greedy's affine (image centres, NCC 2x2x2), then convex_adam_pt as it comes, float32; volumes only"
_FIREANTS = "its quickstart: AffineRegistration and GreedyRegistration, CC of width 5, scales 4, 2, 1"
_FIREANTS_MODULES = ("fireants.io", "fireants.registration.affine", "fireants.registration.greedy")
_DIPY_MODULES = ("dipy.align.imaffine", "dipy.align.imwarp", "dipy.align.metrics", "dipy.align.transforms", "nibabel")

TOOLS: dict[str, Tool] = {
    "unregistered": Tool("simpleitk", ("SimpleITK",), "the images as the files place them", _stay),
    "torchdeform": _torchdeform("default"),
    "torchdeform_fast": _torchdeform("fast"),
    "torchdeform_accurate": _torchdeform("accurate"),
    "torchdeform_smooth": _torchdeform("smooth"),
    "greedy": _Greedy("NMI", "NCC 2x2x2", moments=1).tool(),
    "greedy_centres": _Greedy("NMI", "NCC 2x2x2").tool(),
    "greedy_ncc": _Greedy("NCC 2x2x2", "NCC 2x2x2").tool(),
    "greedy_wncc": _Greedy("NMI", "WNCC 2x2x2", "-sv").tool(),
    "ants_affine": _ants("Affine"),
    "ants_quick": _ants("antsRegistrationSyNQuick[s]"),
    "ants_syn": _ants("SyN"),
    "ants_syncc": _ants("SyNCC"),
    "elastix": Tool("itk-elastix", ("itk", "SimpleITK"), _ELASTIX, _elastix),
    "elastix_rigid": Tool("itk-elastix", ("itk", "SimpleITK"), _RIGIDITY, lambda job: _elastix(job, _rigidity)),
    "dipy": Tool("dipy", (*_DIPY_MODULES, "SimpleITK"), _DIPY, _dipy),
    "convexadam": Tool("convexAdam", ("convexAdam.convex_adam_MIND", "picsl_greedy"), _CONVEX, _convex_adam),
    "fireants": Tool("fireants", (*_FIREANTS_MODULES, "SimpleITK"), _FIREANTS, _fireants),
}


def load(tool: Tool) -> None:
    """Import what a tool needs before the clock starts."""
    for name in tool.imports:
        import_module(name)
    if tool.package == "itk-elastix":  # its modules are loaded at their first use
        itk = import_module("itk")
        for name in ("imread", "ParameterObject", "ElastixRegistrationMethod", "F", "UC"):
            getattr(itk, name)


def limit_threads(threads: int) -> None:
    """Keep this process, and what it starts, on so many cores."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
