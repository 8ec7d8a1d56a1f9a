"""Saved maps, exports, and localization in them."""

from __future__ import annotations

import dataclasses
import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2lidar_node.emulator.world.mapping_scenes import furnished_office, street_block
from l2lidar_node.types import F64, HostNs
from l2lidar_proc.slam import atlas, export, se3
from l2lidar_proc.slam.atlas import AtlasError, AtlasWriter
from l2lidar_proc.slam.config import LocalizationConfig, LoopConfig, SlamConfig
from l2lidar_proc.slam.localization import Localizer, bounded
from l2lidar_proc.slam.nodes import Health, OdometrySweep, SlamState
from l2lidar_proc.slam.slam import Slam
from l2lidar_proc.slam.submap import Submap
from l2lidar_proc.slam.verification import Fit, Match
from tests.l2lidar_proc.conftest import STEP
from tests.support.mapping_runs import MappingRun, drifting, scan, walk


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_saved_map_comes_back_and_saves_to_the_same_bytes(mapped: Slam, tmp_path: Path) -> None:
    built = mapped.map()
    AtlasWriter(tmp_path / "one").save(built)

    loaded, warnings = atlas.load(tmp_path / "one")
    AtlasWriter(tmp_path / "two").save(loaded)

    assert warnings == []
    np.testing.assert_array_equal(loaded.poses, built.poses)
    np.testing.assert_array_equal(loaded.trajectory(), built.trajectory())
    np.testing.assert_array_equal(loaded.points(), built.points())
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_saving_again_replaces_and_leaves_nothing_behind(mapped: Slam, tmp_path: Path) -> None:
    writer = AtlasWriter(tmp_path / "map")
    built = mapped.map()
    half = type(built)(built.nodes[:5], built.poses[:5], built.edges[built.edges["second"] < 5])
    writer.save(built)
    first = contents(tmp_path / "map")
    size = writer.save(half)

    left = contents(tmp_path / "map")
    assert len(left) < len(first)
    assert size == sum(map(len, left.values()))
    assert len(atlas.load(tmp_path / "map")[0].nodes) == 5


def test_whatever_is_cut_off_while_saving_the_map_before_is_whole(
    mapped: Slam, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = mapped.map()
    half = type(built)(built.nodes[:5], built.poses[:5], built.edges[built.edges["second"] < 5])
    write = vars(atlas)["write_whole"]
    for allowed in range(8):  # as if killed after so many files
        monkeypatch.setattr(atlas, "write_whole", write)
        folder, count = tmp_path / str(allowed), 0
        AtlasWriter(folder).save(half)

        def dying(path: Path, content: bytes | str, allowed: int = allowed) -> None:
            nonlocal count
            count += 1
            if count > allowed:
                raise KeyboardInterrupt
            write(path, content)

        monkeypatch.setattr(atlas, "write_whole", dying)
        with pytest.raises(KeyboardInterrupt):
            AtlasWriter(folder).save(built)

        loaded, warnings = atlas.load(folder)
        assert warnings == []
        assert len(loaded.nodes) == 5


def test_a_damaged_submap_is_left_out_with_a_warning(mapped: Slam, tmp_path: Path) -> None:
    built = mapped.map()
    far = next(i for i, node in enumerate(built.nodes) if node.submap is not None)
    submap = built.nodes[far].submap
    assert submap is not None
    beyond = Submap(submap.points, submap.views + np.float32(1e9))  # of a terabyte of free space
    built.nodes[far] = dataclasses.replace(built.nodes[far], submap=beyond)
    AtlasWriter(tmp_path).save(built)
    body = json.loads((tmp_path / atlas.MANIFEST).read_text())["map"]
    number, name = next((i, n) for i, n in enumerate(body["submaps"]) if n and i != far)
    content = bytearray((tmp_path / name).read_bytes())
    content[len(content) // 2] ^= 0x40
    (tmp_path / name).write_bytes(bytes(content))

    loaded, warnings = atlas.load(tmp_path)

    assert len(warnings) == 2
    for left_out, warning in zip((far, number), warnings, strict=True):
        assert f"submap {left_out} is skipped" in warning
        assert loaded.nodes[left_out].submap is None
    assert len(loaded.nodes) == len(mapped.nodes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / atlas.MANIFEST).unlink(), "not a saved map"),
        (lambda folder: (folder / atlas.MANIFEST).write_text("{"), "cannot be read"),
        (lambda folder: (folder / atlas.MANIFEST).write_text("[1]"), "not the manifest"),
        (lambda folder: edit(folder, "version", 9), "version 9 is not known"),
        (lambda folder: edit(folder, "submaps", ["../../etc/passwd"]), "checksum is wrong"),
        (lambda folder: next(folder.glob("graph-*")).write_bytes(b"PK"), "damaged"),
    ],
)
def test_what_is_not_a_map_is_refused_with_a_reason(
    mapped: Slam, tmp_path: Path, change: object, message: str
) -> None:
    AtlasWriter(tmp_path).save(mapped.map())
    assert callable(change)
    change(tmp_path)

    with pytest.raises(AtlasError, match=message):
        atlas.load(tmp_path)


def edit(folder: Path, key: str, value: object) -> None:
    read = json.loads((folder / atlas.MANIFEST).read_text())
    read["map"][key] = value
    (folder / atlas.MANIFEST).write_text(json.dumps(read))


def test_a_folder_with_other_files_is_not_written_to(mapped: Slam, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")

    with pytest.raises(AtlasError, match="contains files that are not a map"):
        AtlasWriter(tmp_path).save(mapped.map())

    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"sprites": []}', "is not the manifest of a saved map"),
        ('{"sha256": "0", "map": {', "cannot be read"),
    ],
)
def test_an_atlas_of_another_program_is_not_written_over(
    mapped: Slam, tmp_path: Path, content: str, said: str
) -> None:
    manifest = tmp_path / atlas.MANIFEST
    manifest.write_text(content)
    with pytest.raises(AtlasError, match=f"{said}.*choose a new or empty folder"):
        AtlasWriter(tmp_path).save(mapped.map())
    assert contents(tmp_path) == {atlas.MANIFEST: content.encode()}


def test_gtsam_reads_the_g2o_file_back(mapped: Slam, tmp_path: Path) -> None:
    gtsam = pytest.importorskip("gtsam")
    built = mapped.map()
    (path,) = export.write(built, "g2o", tmp_path)

    graph, values = gtsam.readG2o(str(path), True)

    assert graph.size() == len(built.edges)
    found = np.stack([values.atPose3(n).matrix() for n in range(len(built.nodes))])
    np.testing.assert_allclose(found, built.poses, atol=1e-6)


def test_every_format_writes_files_that_hold_something(mapped: Slam, tmp_path: Path) -> None:
    for kind in export.FORMATS:
        files = export.write(mapped.map(), kind, tmp_path / kind)
        assert files
        assert all(path.stat().st_size > 0 for path in files)
    submaps = len(mapped.nodes)
    assert len(list((tmp_path / "qn" / "scans").glob("*.pcd"))) == submaps
    assert len(list((tmp_path / "interactive_slam").glob("0*/cloud.pcd"))) == submaps
    tum = (tmp_path / "tum" / "trajectory.tum").read_text().splitlines()
    assert len(tum) == sum(len(node.sweeps) for node in mapped.nodes)


def test_the_occupancy_map_is_free_along_the_way_and_has_walls_beside_it(mapped: Slam) -> None:
    built = mapped.map()
    image, (x0, y0) = export.occupancy(built, 0.05)
    way = built.trajectory()["pose"][:, :2, 3]
    index = np.floor((way - (x0, y0)) / 0.05).astype(int)
    along = image[::-1][index[:, 1], index[:, 0]]

    assert (along == 254).mean() > 0.9
    assert (along == 0).sum() == 0
    assert set(np.unique(image)) == {0, 205, 254}
    assert 0.01 < (image == 0).mean() < 0.5


def test_a_kidnapped_start_is_found_and_kept(mapped: Slam) -> None:
    scene = furnished_office()
    truth = walk(scene, 0.3, step=STEP, seed=4, backwards=True)
    run = scan(scene, truth, step=STEP, rays=4000, seed=4)
    localizer = Localizer(SlamConfig(), mapped.map())
    before = len(mapped.map().points())
    tilt = se3.exp((0.03, -0.02, 0.0, 0.0, 0.0, 0.0))  # of an odometry that began in motion

    seen = []
    for number, sweep in enumerate(run.sweeps(tilt @ drifting(truth, 0.5, 4, STEP))):
        localizer.add(sweep)
        seen.append(localizer.state)
        if localizer.state is SlamState.SEARCHING:
            assert localizer.T_map_odom is None
        if localizer.state is SlamState.LOCALIZED:
            assert localizer.T_map_odom is not None
            assert off_by(localizer.T_map_odom @ sweep.T_odom_body, run, number, mapped) < 0.12

    assert SlamState.LOCALIZED in seen[: round(12.0 / STEP)]
    assert seen[-1] is SlamState.LOCALIZED
    assert len(mapped.map().points()) == before


def off_by(pose: Any, run: MappingRun, number: int, mapped: Slam) -> float:
    """Return the distance [m] from the truth; the map frame is that of the first sweep."""
    first = furnished_walk_start()
    true = se3.inverse(first) @ run.truth[number]
    return float(np.linalg.norm((pose - true)[:3, 3]))


def furnished_walk_start() -> Any:
    return se3.leveled(walk(furnished_office(), 0.1, step=STEP)[0])


def test_a_direction_that_registration_leaves_open_is_bounded_and_the_others_stay() -> None:
    along = se3.exp((0.0, 0.0, 0.6, 0.0, 0.0, 0.0))
    ad = se3.adjoint(along)
    open_ahead = ad @ np.diag((1e-6, 1e-6, 1e-6, 900.0, 1e-4, 1e-4)) @ ad.T

    found = se3.adjoint(se3.inverse(along)) @ bounded(open_ahead, 0.3) @ ad

    np.testing.assert_allclose(np.diag(found)[3:], (0.09, 1e-4, 1e-4), rtol=2e-3)
    np.testing.assert_allclose(np.diag(found)[:3], 1e-6, rtol=1e-3)


def test_a_start_outside_the_map_announces_nothing(mapped: Slam) -> None:
    scene = street_block()
    truth = walk(scene, 0.05, step=STEP, seed=2)
    run = scan(scene, truth, step=STEP, rays=4000, seed=2)
    localizer = Localizer(SlamConfig(), mapped.map())

    for sweep in run.sweeps(drifting(truth, 0.5, 2, STEP)):
        localizer.add(sweep)
        assert localizer.state is not SlamState.LOCALIZED
        assert localizer.T_map_odom is None


def test_a_given_pose_is_corrected_by_the_map(office: MappingRun, mapped: Slam) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    run = office.part(20, 50)
    odometry = drifting(run.truth, 0.5, 9, STEP)
    assert not localizer.set_pose(0.0, 0.0, 0.0)
    true = se3.inverse(se3.leveled(office.truth[0])) @ run.truth
    for number, sweep in enumerate(run.sweeps(odometry)):
        localizer.add(sweep)
        if number == 0:
            x, y, _ = true[0, :3, 3]
            assert localizer.set_pose(x + 0.4, y - 0.3, se3.yaw_of(true[0]) + 0.1)

    assert localizer.state is SlamState.LOCALIZED
    assert localizer.T_map_odom is not None
    assert np.linalg.norm((localizer.T_map_odom @ odometry[-1] - true[-1])[:3, 3]) < 0.12


def test_a_place_that_three_looks_contradict_is_given_up_for_theirs(
    office: MappingRun, mapped: Slam
) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    true = se3.inverse(se3.leveled(office.truth[0])) @ office.truth[20:60]
    sweeps = list(office.part(20, 60).sweeps(true))
    beside = se3.planar(0.3, -0.3, 0.0)
    localizer.take_over(beside, np.eye(6) * 1e-4)  # more certain than it should be
    off = []
    for sweep in sweeps:
        localizer.add(sweep)
        assert localizer.state is SlamState.LOCALIZED
        assert localizer.T_map_odom is not None
        here = (localizer.T_map_odom @ sweep.T_odom_body - sweep.T_odom_body)[:3, 3]
        off.append(float(np.linalg.norm(here)))

    assert off[10] > 0.35  # one look is not believed
    assert off[-1] < 0.12


def test_far_from_the_map_the_place_is_carried_on_then_lost(
    office: MappingRun, mapped: Slam
) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    true = se3.inverse(se3.leveled(office.truth[0])) @ office.truth
    sweeps = list(office.sweeps(true))
    localizer.add(sweeps[0])
    localizer.set_pose(float(true[0, 0, 3]), float(true[0, 1, 3]), se3.yaw_of(true[0]))
    for sweep in sweeps[1:30]:
        localizer.add(sweep)
    assert localizer.state is SlamState.LOCALIZED
    states = []
    street = street_block()
    truth = walk(street, 0.12, step=STEP, seed=1)
    run = scan(street, truth, step=STEP, rays=1500)
    onward = sweeps[29].T_odom_body @ se3.inverse(truth[0]) @ truth
    for sweep in run.sweeps(onward):
        localizer.add(sweep)
        states.append(localizer.state)

    assert SlamState.DEAD_RECKONING in states
    assert localizer.T_map_odom is not None
    assert localizer.sigma > 0.05


@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_a_sensor_that_rests_or_turns_on_the_spot_takes_no_more_memory(
    mapped: Slam, degrees: float
) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    points = np.zeros((1000, 3))
    tracemalloc.start()
    for number in range(1000):
        pose = se3.planar(0.0, 0.0, np.radians(degrees * number))
        localizer.add(
            OdometrySweep(HostNs(number), pose, points.copy(), Health.GOOD, np.zeros((6, 6)))
        )
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert kept < (250 if degrees else 10) * points.nbytes


def test_an_exact_match_corrects_a_pose_whose_heading_is_off(mapped: Slam) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    localizer.add(OdometrySweep(HostNs(0), np.eye(4), np.zeros((1, 3)), Health.GOOD, np.eye(6)))
    localizer.set_pose(1.0, 0.0, np.radians(15.0))
    assert localizer.T_map_odom is not None
    true = np.eye(4)
    exact = np.diag(np.repeat((1e-3**2, 0.01**2), 3))
    match = Match(se3.inverse(mapped.poses[0]) @ true, exact, Fit(0.9, 0.95, 0.0), 0.1, True)

    vars(Localizer)["_correct"](localizer, np.eye(4), localizer.T_map_odom, 0, match)

    assert np.linalg.norm(localizer.T_map_odom[:2, 3]) < 0.005
    assert abs(se3.yaw_of(localizer.T_map_odom)) < np.radians(0.1)


def test_after_a_cut_the_held_pose_has_an_unknown_covariance(mapped: Slam) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    localizer.take_over(np.eye(4), np.eye(6) * 1e-4)
    nothing = np.zeros((1, 3))
    for number, health in enumerate((Health.GOOD, Health.CUT, Health.GOOD)):
        localizer.add(OdometrySweep(HostNs(number), np.eye(4), nothing, health, np.zeros((6, 6))))

    assert localizer.state is SlamState.LOST
    assert np.sqrt(np.linalg.eigvalsh(localizer.covariance)[0]) > 1.0


def degenerate(pose: F64, covariance: F64, health: Health = Health.DEGENERATE) -> OdometrySweep:
    return OdometrySweep(HostNs(0), pose, np.zeros((1, 3)), health, covariance)


@pytest.mark.parametrize("flickers", [False, True])
def test_a_sensor_parked_in_a_corridor_keeps_its_place(mapped: Slam, flickers: bool) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    localizer.take_over(np.eye(4), np.eye(6) * 1e-4)
    rng = np.random.default_rng(0)
    for number in range(3000):  # the odometry's covariance is never quite the same
        covariance = rng.uniform(0.95, 1.05) * np.diag((0.09, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6))
        health = Health.GOOD if flickers and number % 2 else Health.DEGENERATE
        localizer.add(degenerate(np.eye(4), covariance, health))

    assert localizer.state is SlamState.LOCALIZED
    assert localizer.sigma < 0.12


def test_what_the_odometry_does_not_fix_widens_the_place_in_the_axes_of_the_map(
    mapped: Slam,
) -> None:
    localizer = Localizer(SlamConfig(), mapped.map())
    localizer.take_over(se3.planar(0.0, 0.0, np.pi / 2.0), np.eye(6) * 1e-4)
    for number in range(51):  # from 0.5 m to 1.118 m: 1 m^2 more, ahead
        ahead = 0.25 + 0.02 * number
        covariance = np.diag((ahead, 0.01, 0.01, 1e-4, 1e-4, 1e-4))
        localizer.add(degenerate(np.eye(4), covariance))

    np.testing.assert_allclose(
        np.diag(localizer.covariance), (1e-4, 1e-4, 1e-4, 1e-4, 1.0 + 1e-4, 1e-4), atol=1e-9
    )


@pytest.mark.parametrize("relocalize", ["auto", "never"])
def test_a_wrong_initial_pose_is_given_up_where_the_place_may_be_searched_for(
    office: MappingRun, mapped: Slam, relocalize: str
) -> None:
    config = SlamConfig(localization=LocalizationConfig(relocalize=relocalize))
    localizer = Localizer(config, mapped.map())
    true = se3.inverse(se3.leveled(office.truth[0])) @ office.truth[:150]
    for number, sweep in enumerate(office.part(0, 150).sweeps(true)):
        localizer.add(sweep)
        if number == 0:
            localizer.set_pose(500.0, 500.0, 0.0)
        if number < 38:  # 19 m
            assert localizer.state is SlamState.TENTATIVE

    if relocalize == "never":
        assert localizer.state is SlamState.TENTATIVE
    else:
        assert localizer.state is SlamState.LOCALIZED
        assert localizer.T_map_odom is not None
        assert np.linalg.norm((localizer.T_map_odom @ true[-1] - true[-1])[:3, 3]) < 0.2


def test_what_a_killed_first_save_left_is_removed_by_the_next(
    mapped: Slam, tmp_path: Path
) -> None:
    left = [
        tmp_path / f".part-{name}"
        for name in (f"submap-{'0f' * 12}.npz", f"graph-{'a1' * 12}.npz", atlas.MANIFEST)
    ]
    for path in left:
        path.write_bytes(b"PK")

    AtlasWriter(tmp_path).save(mapped.map())

    assert not any(path.exists() for path in left)
    assert len(atlas.load(tmp_path)[0].nodes) == len(mapped.nodes)


def test_files_that_someone_put_beside_a_map_stay_as_they_are(
    mapped: Slam, tmp_path: Path
) -> None:
    AtlasWriter(tmp_path).save(mapped.map())
    notes, part = tmp_path / "notes.txt", tmp_path / ".part-notes.txt"
    for path in (notes, part):
        path.write_text("third floor")

    AtlasWriter(tmp_path).save(mapped.map())

    assert notes.read_text() == part.read_text() == "third floor"


def test_a_submap_that_could_not_be_read_is_not_deleted_by_the_next_save(
    mapped: Slam, tmp_path: Path
) -> None:
    AtlasWriter(tmp_path / "map").save(mapped.map())
    body = json.loads((tmp_path / "map" / atlas.MANIFEST).read_text())["map"]
    number, name = next((i, name) for i, name in enumerate(body["submaps"]) if name)
    path = tmp_path / "map" / name
    sound = path.read_bytes()
    path.write_bytes(sound[:-1])

    loaded, (warning,) = atlas.load(tmp_path / "map")
    grown = Slam(SlamConfig(loop=LoopConfig(loops=False)), loaded)
    AtlasWriter(tmp_path / "map").save(grown.map())
    AtlasWriter(tmp_path / "copy").save(grown.map())

    assert warning.endswith("; its file is kept")
    assert path.read_bytes() == sound[:-1]
    path.write_bytes(sound)  # the disk can be read again
    again, warnings = atlas.load(tmp_path / "map")
    assert warnings == []
    assert again.nodes[number].submap is not None
    copy, warnings = atlas.load(tmp_path / "copy")
    assert warnings == []
    assert copy.nodes[number].submap is None


def test_a_submap_whose_file_is_missing_is_left_out_for_good(mapped: Slam, tmp_path: Path) -> None:
    AtlasWriter(tmp_path).save(mapped.map())
    next(tmp_path.glob("submap-*")).unlink()

    loaded, (warning,) = atlas.load(tmp_path)
    AtlasWriter(tmp_path).save(loaded)

    assert "is kept" not in warning
    assert atlas.load(tmp_path)[1] == []
