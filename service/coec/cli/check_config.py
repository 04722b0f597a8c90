"""`coec check-config`: shows the effective configuration of a file, before a vehicle depends on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import Json
from coec.errors import ConfigError, ModelError, UsageError, require_readable
from coec.reports import console

if TYPE_CHECKING:
    from coec.config import Config, OpenPairConfig, PairConfig

TEMPLATE_HEAD = """\
# Configuration of coec. Every key stands here with its default, except for what only you can know: the names, keys,
# intrinsics and extrinsic below `pairs` are an example. Unknown keys are refused. Relative paths are relative to this
# file. `coec check-config FILE` prints what a configuration comes to.
"""


def check_config(
    file: Annotated[Path | None, typer.Argument(help="Configuration (YAML).", show_default=False, readable=False)] = (
        None
    ),
    defaults: Annotated[bool, typer.Option("--defaults", help="Print a commented template instead.")] = False,
    as_json: Json = False,
) -> int:
    """Print the effective configuration with every default; exit 78 if it, or a file it names, cannot be used."""
    from coec.config import config_hash, load_config
    from coec.io.zenoh.command_auth import CommandListener, credentials_of
    from coec.io.zenoh.session import check_certificates, settings_of, settings_source
    from coec.reports.commented_yaml import commented_yaml

    if defaults == (file is not None):
        raise UsageError("give a configuration file, or --defaults")
    if file is None:
        console.report(
            {"config": example().model_dump(mode="json")},
            lambda: console.show_lines(template().rstrip("\n")),
            as_json=as_json,
        )
        return 0
    config = load_config(file)
    checks = [check for pair in config.pairs for check in _check(pair, config)]
    checks += [check for pair in config.awaited for check in _check_undiscovered(pair, config)]
    if config.left_out:
        checks.append(f"no pairs of sensors that see nothing in common: {', '.join(config.left_out)}")
    if config.zenoh.file is not None:
        checks.append(_check_file(config.zenoh.file, "zenoh.file"))
    check_certificates(settings_of(config.zenoh, config.limits), settings_source(config.zenoh))
    credentials = credentials_of(config.authority)
    if credentials is not None:
        CommandListener(credentials)
        checks.append(f"authority.certificate {credentials.certificate}")
    digest = config_hash(config)
    if as_json:
        document = {"config": config.model_dump(mode="json"), "config_hash": digest, "checks": checks}
        console.print_json(document)
        return 0
    console.show_lines(commented_yaml(config).strip("\n"))
    console.show("")
    console.show(f"# config hash {digest}")
    for check in checks:
        console.show(f"# ok: {check}")
    return 0


def template() -> str:
    """The commented template."""
    from coec.reports.commented_yaml import commented_yaml

    return TEMPLATE_HEAD + commented_yaml(example())


def example() -> Config:
    """A vehicle with one fisheye camera and one spinning LiDAR, defaults everywhere else."""
    from coec.config import (
        CameraConfig,
        CameraIntrinsics,
        Config,
        EgoConfig,
        LidarConfig,
        PairConfig,
        StateConfig,
        SweepConfig,
    )

    intrinsics = CameraIntrinsics(
        model="double_sphere", width=1400, height=1400, fx=430.0, fy=430.0, cx=699.5, cy=699.5, xi=-0.2, alpha=0.6
    )
    pair = PairConfig(
        name="front",
        camera=CameraConfig(key="sensors/front/camera", intrinsics=intrinsics),
        lidar=LidarConfig(key="sensors/front/lidar", sweep=SweepConfig()),
        ego=EgoConfig(key="sensors/front/ego"),
        # Camera looking ahead: its x, y, z axes are right, down, forward; those of the LiDAR forward, left, up.
        T_camera_lidar=((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, -0.4), (1.0, 0.0, 0.0, -0.9), (0.0, 0.0, 0.0, 1.0)),
    )
    return Config(state=StateConfig(directory=Path("/var/lib/coec")), pairs=(pair,))


def _check(pair: PairConfig, config: Config) -> list[str]:
    """What is usable of a pair; reads the mask and opens the network.

    Raises:
        ConfigError: the rig or the network cannot be used.
    """
    from coec.io.rig_files import rig_of

    rig = rig_of(pair)
    mask = f", mask {pair.camera.mask}" if rig.mask is not None else ""
    return [f"pair {pair.name}: rig {pair.camera.intrinsics.model}{mask}", _check_network(pair, config)]


def _check_undiscovered(pair: OpenPairConfig, config: Config) -> list[str]:
    """What is usable of a pair whose rig the service discovers from its sensors.

    Raises:
        ConfigError: the given parts of the rig, or the network, cannot be used.
    """
    from coec.io.rig_files import check_given

    check_given(pair)
    rig = "its frames, and what else is left out, come from /tf_static and CameraInfo when the service runs"
    return [f"pair {pair.name}: {rig}", _check_network(pair, config)]


def _check_network(pair: OpenPairConfig, config: Config) -> str:
    from coec.io.depth.depth_maps import open_depth

    try:
        depth = open_depth(pair.calibration.depth, config.limits)
    except ModelError as error:
        raise ConfigError(f"pair {pair.name}, calibration.depth.model: {error}") from error
    return f"pair {pair.name}: depth {pair.calibration.depth.model}, identity {depth.identity}"


def _check_file(path: Path, key: str) -> str:
    require_readable(path, key)
    return f"{key} {path}"
