"""Which LiDARs are looked at together, where they were built, and why some are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coec.calibration.rig import nearest_neighbours
from coec.geometry import se3
from coec.service.engine import lidar_pairs
from coec.service.engine.lidar_pairs import plan_lidar_pairs
from support.rigs import LIDAR_POSES, LIDARS, LidarBench, lidar_pair, with_extra

__all__ = ["with_extra"]


@pytest.mark.usefixtures("with_extra")
def test_every_two_lidars_of_the_pairs_in_their_order() -> None:
    result = plan_lidar_pairs([lidar_pair(lidar) for lidar in LIDARS], 15.0)
    assert [one.edge.name for one in result] == ["roof to bumper", "roof to trunk", "bumper to trunk"]
    for one in result:
        assert one.why_not is None
        truth = LIDAR_POSES[one.rig.a] @ se3.inverse(LIDAR_POSES[one.rig.b])
        np.testing.assert_allclose(one.rig.T_a_b_nominal, truth, atol=1e-9)
    assert plan_lidar_pairs([lidar_pair("roof")], 15.0) == ()


@pytest.mark.fault("the extra lidars is not installed", "status and rig say so; nothing breaks")
def test_what_is_not_installed_is_reported_and_breaks_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nearest_neighbours, "installed", lambda: False)
    bench = LidarBench(tmp_path)
    bench.drive(0.0, 20.0)
    assert bench.edges.problem is not None
    assert bench.edges.problem.code == "lidars_not_installed"
    assert {one.state for one in bench.reply.lidars} == {"not_measured"}
    (reason,) = bench.reply_between("roof to bumper").reasons
    assert "extra lidars is not installed" in reason.text
    assert bench.worker.stamps == []


@pytest.mark.usefixtures("with_extra")
def test_what_is_switched_off_or_cannot_be_is_reported(tmp_path: Path) -> None:
    off = LidarBench(tmp_path / "off", period_s=0.0)
    assert [reason.code for reason in off.reply_between("roof to bumper").reasons] == ["switched_off"]
    assert off.edges.problem is None
    without = LidarBench(tmp_path / "without", ego=False)
    assert [reason.code for reason in without.reply_between("roof to bumper").reasons] == ["no_ego_motion"]
    rear = lidar_pair("bumper")
    rear = rear.model_copy(update={"camera": rear.camera.model_copy(update={"name": "rear", "key": "in/rear"})})
    (separation,) = plan_lidar_pairs([lidar_pair("roof"), rear], 15.0)
    assert separation.why_not is not None
    assert separation.why_not.code == "no_nominal_pose"


@pytest.mark.usefixtures("with_extra")
def test_their_number_is_bounded() -> None:
    lidars = [lidar_pair("roof")]
    for number in range(4):
        lidar = lidars[0].lidar.model_copy(update={"name": f"lidar{number}", "key": f"in/lidar{number}"})
        lidars.append(lidars[0].model_copy(update={"name": f"front-lidar{number}", "lidar": lidar}))
    result = plan_lidar_pairs(lidars, 15.0)
    assert [one.why_not for one in result].count(None) == lidar_pairs.MAX_LIDAR_PAIRS
    assert {one.why_not.code for one in result if one.why_not is not None} == {"too_many"}


@pytest.mark.usefixtures("with_extra")
def test_lidars_of_pairs_that_are_detected_later_join(tmp_path: Path) -> None:
    bench = LidarBench(tmp_path, lidars=("roof", "bumper"))
    bench.join("trunk")
    bench.edges.grow([lidar_pair(lidar) for lidar in LIDARS])
    bench.settle()
    assert len(bench.reply.lidars) == 3
    bench.drive(0.0, 30.0)
    assert {one.state for one in bench.reply.lidars} == {"measured"}
