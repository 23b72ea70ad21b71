"""What runs COLMAP: `python -m slomo.reconstruct.colmap DIR`, on the images, masks and job.json that `sfm` puts there.

Leaves out.npz, or nothing where there is no model; and the features and matches, which the next job finds. Must not
import OpenCV, which does not load beside pycolmap.
"""

import json
import os
import shutil
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from slomo.reconstruct.sfm import ENOUGH
from slomo.threads import cores

# Degrees between rays, of the first pair and of any point. COLMAP's usual ones give the better structure; a hand-held
# clip that turns more than it travels has no points left at those.
_ANGLES = ((16.0, 1.5), (4.0, 0.4))
_ROUNDS = 3  # of points and bundle adjustment, from a path that is known
_LEAST_POINTS = 3  # points for each key frame, without which a path that is known is worth nothing
_ENOUGH_POINTS = 10  # points for each key frame, below which the next angles are tried
# Seconds of a mapping at most, by the clock: a net for one that does not end, which a busy machine must not run into.
_MAX_SECONDS, _MAX_SECONDS_EACH = 180, 8.0  # at least, and for each key frame


def _end_with(parent: int, folder: str) -> None:
    """End this process when its parent has gone, even by SIGKILL, and tidy up in its place: the whole workspace."""
    while os.getppid() == parent:
        time.sleep(0.5)
    shutil.rmtree(Path(folder).parent, ignore_errors=True)
    os._exit(1)


def _main(folder: str) -> None:
    threading.Thread(target=_end_with, args=(os.getppid(), folder), daemon=True).start()
    root = Path(folder)
    job = json.loads((root / "job.json").read_text())
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(job["seed"])
    database, images = root / "database.db", root / "images"
    if not (root / "matched").exists():
        _match(root, database, images, job)
        (root / "matched").touch()
    with pycolmap.Database.open(database) as db:
        camera = db.read_all_cameras()[0]
        camera.params = [job["focal"], *job["center"]]
        db.update_camera(camera)
    find = _mapped if job["path"] is None else _placed
    model, angle = find(root, database, images, job)
    if model is not None:
        np.savez(root / "out.npz", allow_pickle=False, least_angle=np.array(angle), **_arrays(model))


def _match(root: Path, database: Path, images: Path, job: dict[str, Any]) -> None:
    """Features of the pictures and their matches, into the database."""
    database.unlink(missing_ok=True)  # of a process that crashed
    reader = pycolmap.ImageReaderOptions()
    reader.mask_path = str(root / "masks")
    reader.camera_model = "SIMPLE_PINHOLE"
    if job["refine_focal"]:
        # Not as camera_params: COLMAP would trust it, and verify pairs of frames with a wrong essential matrix.
        reader.default_focal_length_factor = job["focal"] / (2 * max(job["center"]))
    else:
        reader.camera_params = ",".join(map(str, [job["focal"], *job["center"]]))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = job["features"]
    # Each picture is looked at by itself, so that what is found does not depend on the threads; its number would, by
    # which everything after is ordered, were the pictures not entered before.
    extraction.num_threads, extraction.use_gpu = cores(), False
    with pycolmap.Database.open(database):
        pass
    single = pycolmap.CameraMode.SINGLE
    pycolmap.import_images(database, images, camera_mode=single, options=reader)
    pycolmap.extract_features(
        database, images, camera_mode=single, reader_options=reader, extraction_options=extraction
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = job["threads"], False
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap, pairing.quadratic_overlap, pairing.num_threads = job["overlap"], True, job["threads"]
    pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)


def _mapping(job: dict[str, Any], count: int, first_angle: float, angle: float):
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.random_seed = job["threads"], job["seed"]
    # A first pair that leads nowhere is dropped and another is tried, which only happens with several models.
    mapping.multiple_models, mapping.max_num_models, mapping.extract_colors = True, 3, False
    mapping.max_runtime_seconds = round(max(_MAX_SECONDS, _MAX_SECONDS_EACH * count))
    mapping.mapper.filter_min_tri_angle = mapping.triangulation.min_angle = angle
    mapping.mapper.init_min_tri_angle = first_angle
    mapping.ba_refine_focal_length = job["refine_focal"]
    return mapping


def _mapped(root: Path, database: Path, images: Path, job: dict[str, Any]):
    """The best model that grows from a pair of frames, and its least angle."""
    count = len(list(images.iterdir()))
    best, best_angle, best_rank = None, 0.0, (False, False, 0)
    for first_angle, angle in _ANGLES:
        models = pycolmap.incremental_mapping(database, images, root, _mapping(job, count, first_angle, angle))
        for model in models.values():
            rank = _rank(model, count)
            if rank[:2] > best_rank[:2] or (rank[:2] == best_rank[:2] == (False, False) and rank > best_rank):
                best, best_angle, best_rank = model, angle, rank
        if all(best_rank[:2]):
            break
    return best, best_angle


def _rank(model, count: int) -> tuple[bool, bool, int]:
    """Whether there are enough frames and points, and how many frames."""
    registered = model.num_reg_images()
    return registered >= ENOUGH * count, model.num_points3D() >= _ENOUGH_POINTS * registered, registered


def _placed(root: Path, database: Path, images: Path, job: dict[str, Any]):
    """A model whose cameras are known but for a little, and its least angle."""
    with pycolmap.Database.open(database) as db:
        found, camera = db.read_all_images(), db.read_all_cameras()[0]
    best, best_angle = None, 0.0
    for _, angle in _ANGLES:
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(camera)
        for image in found:
            T = np.linalg.inv(np.array(job["path"][image.name]))
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T[:3]))
        mapping = _mapping(job, len(found), 0.0, angle)
        adjustment = pycolmap.BundleAdjustmentOptions()
        adjustment.refine_focal_length = job["refine_focal"]
        adjustment.print_summary = False
        adjustment.ceres.solver_options.num_threads = job["threads"]
        adjustment.ceres.solver_options.function_tolerance = 1e-6
        for _ in range(_ROUNDS):
            model = pycolmap.triangulate_points(model, database, images, root, options=mapping)
            if model.num_points3D() < _LEAST_POINTS * len(found):
                break
            pycolmap.bundle_adjustment(model, adjustment)
            # Points that it has sent to infinity or behind a camera.
            pycolmap.ObservationManager(model).filter_all_points3D(mapping.mapper.filter_max_reproj_error, angle)
        if model.num_points3D() >= _LEAST_POINTS * len(found):
            model.normalize()
            best, best_angle = model, angle
        if model.num_points3D() >= _ENOUGH_POINTS * len(found):
            break
    return best, best_angle


def _arrays(model) -> dict[str, np.ndarray]:
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    point_ids = sorted(model.points3D)
    place = {p: n for n, p in enumerate(point_ids)}
    T, observations, xy = [], [], []
    for n, image in enumerate(images):
        T.append(np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]]))
        for point in image.points2D:
            if point.has_point3D():
                observations.append((n, place[point.point3D_id]))
                xy.append(point.xy - 0.5)  # COLMAP puts the first pixel's centre at 0.5
    return {
        "frames": np.array([int(Path(image.name).stem) for image in images]),
        "T_world_cam": np.array(T),
        "focal": np.array(next(iter(model.cameras.values())).params[0]),
        "points": np.array([model.points3D[p].xyz for p in point_ids]),
        "observations": np.array(observations),
        "xy": np.array(xy),
        "error_px": np.array(model.compute_mean_reprojection_error()),
    }


if __name__ == "__main__":
    _main(sys.argv[1])
