"""The command line: what every command takes. What it does is in the module of its name, imported when it is called.

Exit codes (CONTRACT, "Command line") are those of `exit_codes`. With `--json`, standard output holds one JSON document
and nothing else.
"""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from coec.cli.exit_codes import BROKEN_PIPE, FAULT
from coec.errors import CoecError, UsageError

SOURCE_HELP = (
    "a recorded window or ROS 2 bag (.mcap), kitti360:ROOT?camera=image_00, kitti-raw:ROOT?..., a folder or "
    "dataset.yaml, sim:seed=1&seconds=60"
)

app = typer.Typer(
    name="coec",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Continuous online extrinsic calibration of a camera and a LiDAR.",
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on standard output, nothing else.")]
Source = Annotated[str, typer.Argument(metavar="SOURCE", help=SOURCE_HELP, show_default=False)]
ConfigFile = Annotated[
    Path, typer.Option("--config", help="Configuration of the daemon (YAML).", metavar="FILE", show_default=False)
]
DEFAULT_CONNECT = "tcp/127.0.0.1:7447"
"""As `config` has it, which takes too long to import for a help text."""

Connect = Annotated[
    str | None, typer.Option(help="Zenoh endpoint of the router.", metavar="ENDPOINT", show_default=DEFAULT_CONNECT)
]


class Middleware(StrEnum):
    """How a recording speaks on the bus."""

    NATIVE = "native"
    RMW_ZENOH = "rmw_zenoh"
    ROS2DDS = "ros2dds"


class Encoding(StrEnum):
    """Encodings of frames."""

    MSGPACK = "msgpack"
    CDR = "cdr"


class DegreesOfFreedom(StrEnum):
    """Of the search."""

    ROTATION = "3"
    ALL = "6"


# What several commands take.
Depth = Annotated[
    str | None,
    typer.Option(
        help="An ONNX file, a built-in name (`coec models`), or `stereo`: the maps of the source. Without it, what a "
        "recorded window names, else the network that comes with coec.",
        metavar="MODEL",
    ),
]
Objective = Annotated[
    str | None,
    typer.Option(help="What is maximised: fused (edges and depth), mi (the paper), intensity.", metavar="NAME"),
]
CameraModel = Annotated[
    str | None,
    typer.Option(help="Fit this model to the camera, and use it instead: double_sphere.", metavar="NAME"),
]
Frames = Annotated[
    int | None, typer.Option(help="Use at most so many camera frames, evenly chosen.", min=1, show_default="25")
]
NoMotionCompensation = Annotated[
    bool, typer.Option("--no-motion-compensation", help="Take the clouds as they were recorded.")
]


@app.command("calibrate")
def _calibrate(
    source: Source,
    depth: Depth = None,
    objective: Objective = None,
    dof: Annotated[DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.")] = None,
    perturb: Annotated[
        str | None,
        typer.Option(
            help="Move the start: degrees and metres about and along the camera axes.", metavar="RX,RY,RZ[,TX,TY,TZ]"
        ),
    ] = None,
    camera_model: CameraModel = None,
    frames: Frames = None,
    no_motion_compensation: NoMotionCompensation = False,
    time_offset: Annotated[
        bool, typer.Option("--time-offset", help="Also estimate the offset of the camera's clock, if turns show it.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option(help="Write overlay_before.png, overlay_after.png and result.json.", metavar="DIR")
    ] = None,
    as_json: Json = False,
) -> None:
    """Calibrate from a recording: exit 0 if the result is accepted, 1 if the self-diagnosis refuses it."""
    from coec.cli import calibrate as command

    options = command.Options(
        source=source,
        depth=depth,
        objective=objective,
        dof=None if dof is None else int(dof.value),
        perturb=perturb,
        camera_model=camera_model,
        frames=frames,
        no_motion_compensation=no_motion_compensation,
        time_offset=time_offset,
        output=output,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("evaluate")
def _evaluate(
    rotation_deg: Annotated[
        float, typer.Option(help="Radius of the sphere of starts, degrees.", metavar="R", min=0, show_default=False)
    ],
    source: Annotated[str | None, typer.Argument(metavar="SOURCE", help=SOURCE_HELP, show_default=False)] = None,
    closure: Annotated[
        tuple[str, str] | None,
        typer.Option(
            help="Instead of SOURCE: two cameras (or LiDARs) of one vehicle, each calibrated by itself; tells how "
            "far their results miss the pose between them.",
            metavar="A B",
        ),
    ] = None,
    relative: Annotated[
        str | None,
        typer.Option(
            help="With --closure: pose of sensor A in the frame of B, degrees and metres; without it, as the "
            "calibrations of both recordings tell.",
            metavar="RX,RY,RZ,TX,TY,TZ",
        ),
    ] = None,
    directions: Annotated[int, typer.Option(help="Number of starts.", metavar="N", min=1)] = 200,
    translation_m: Annotated[
        float, typer.Option(help="Radius of the sphere of starts, metres.", metavar="T", min=0)
    ] = 0.0,
    depth: Depth = None,
    objective: Annotated[
        str | None,
        typer.Option(
            help="What is maximised: fused, mi, intensity as for calibrate, or all: the three side by side.",
            metavar="NAME",
        ),
    ] = None,
    dof: Annotated[
        DegreesOfFreedom | None,
        typer.Option(help="Rotation only, or translation too; 6 if --translation-m is given.", show_default=False),
    ] = None,
    camera_model: CameraModel = None,
    frames: Frames = None,
    no_motion_compensation: NoMotionCompensation = False,
    against_frames: Annotated[
        bool, typer.Option("--against-frames", help="Also solve windows of 1, 2, 3, 5, ... frames: frames.png.")
    ] = False,
    against_slice: Annotated[
        bool, typer.Option("--against-slice", help="Also solve slices of 1/16 to all of the recording: slices.png.")
    ] = False,
    halves: Annotated[
        int,
        typer.Option(
            help="Also split the frames N times at random into disjoint halves and compare their results.",
            metavar="N",
            min=0,
        ),
    ] = 0,
    nees: Annotated[
        int,
        typer.Option(
            help="Also hold errors against claimed standard deviations: N windows one after the other against the "
            "truth (of a recording: its own calibration), and N splits into halves: normalised.png.",
            metavar="N",
            min=0,
        ),
    ] = 0,
    detection: Annotated[
        int,
        typer.Option(
            help="Also say how well moved extrinsics are seen, over N splits of the frames, as diagnose does.",
            metavar="N",
            min=0,
        ),
    ] = 0,
    steps: Annotated[
        int,
        typer.Option(
            help="Also lay knocks of several sizes into the recording, N of each at drawn times: is it refused, is the "
            "time told?",
            metavar="N",
            min=0,
        ),
    ] = 0,
    output: Annotated[
        Path | None, typer.Option(help="Write plots, overlays, starts.csv and report.json.", metavar="DIR")
    ] = None,
    as_json: Json = False,
) -> None:
    """Solve from starts all around the source's calibration: hit rate, bias, spread, and how good the verdicts are."""
    from coec.cli import closure as closure_command
    from coec.cli import evaluate as command

    if (source is None) == (closure is None):
        raise UsageError("coec evaluate: give a SOURCE, or --closure A B, and not both")
    options = command.Options(
        source=source or "",
        rotation_deg=rotation_deg,
        directions=directions,
        translation_m=translation_m,
        depth=depth,
        objective=objective,
        dof=None if dof is None else int(dof.value),
        camera_model=camera_model,
        frames=frames,
        no_motion_compensation=no_motion_compensation,
        against_frames=against_frames,
        against_slice=against_slice,
        halves=halves,
        nees=nees,
        detection=detection,
        steps=steps,
        output=output,
        as_json=as_json,
    )
    if closure is None:
        if relative is not None:
            raise UsageError("--relative tells the pose between two sources: it needs --closure A B")
        raise typer.Exit(command.run(options))
    others = (against_frames, against_slice, halves, nees, detection, steps, camera_model)
    if objective == command.ALL or any(others):
        raise UsageError(
            "--closure is an experiment of its own: leave out --objective all, --against-frames, --against-slice, "
            "--halves, --nees, --detection, --steps and --camera-model"
        )
    raise typer.Exit(closure_command.run(closure_command.Options(*closure, options, relative)))


@app.command("commission")
def _commission(
    sources: Annotated[list[str], typer.Argument(metavar="SOURCE...", help=SOURCE_HELP, show_default=False)],
    output: Annotated[Path, typer.Option(help="Baseline to write, or to add the pair to.", metavar="FILE")] = Path(
        "rig.json"
    ),
    depth: Depth = None,
    objective: Objective = None,
    dof: Annotated[DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.")] = None,
    frames: Frames = None,
    false_alarm_rate: Annotated[
        float, typer.Option(help="Share of checks at a right extrinsic that may be flagged.", min=1e-4, max=0.2)
    ] = 0.01,
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="camera=SERIAL or lidar=SERIAL; repeatable.", metavar="STREAM=SERIAL", show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Learn the baseline of a rig from windows in which its calibration is right: bias, spread, every limit."""
    from coec.cli import commission as command

    options = command.Options(
        sources=tuple(sources),
        output=output,
        depth=depth,
        objective=objective,
        dof=None if dof is None else int(dof.value),
        frames=frames,
        false_alarm_rate=false_alarm_rate,
        sensors=tuple(sensor or ()),
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("diagnose")
def _diagnose(
    source: Source,
    depth: Depth = None,
    rig: Annotated[
        Path | None, typer.Option(help="Baseline from `coec commission`.", metavar="FILE", show_default=False)
    ] = None,
    perturb: Annotated[
        str | None,
        typer.Option(help="Move the extrinsic: degrees and metres.", metavar="RX,RY,RZ[,TX,TY,TZ]"),
    ] = None,
    detection: Annotated[
        int,
        typer.Option(
            help="Instead, print how well moved extrinsics are seen, over N splits of the pairs.", metavar="N", min=0
        ),
    ] = 0,
    checks: Annotated[int, typer.Option(help="Checks per split and move, with --detection.", min=1)] = 10,
    frames: Frames = None,
    as_json: Json = False,
) -> None:
    """Take one check of the extrinsic of a recording, as the service does every few seconds: exit 1 if it is wrong."""
    from coec.cli import diagnose as command

    options = command.Options(
        source=source,
        depth=depth,
        rig=rig,
        perturb=perturb,
        detection=detection,
        checks=checks,
        frames=frames,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("alarms")
def _alarms(
    hours: Annotated[float, typer.Option(help="Hours of driving with a right mount.", min=0.1)] = 100.0,
    steps: Annotated[int, typer.Option(help="Drawn steps of every size.", min=1)] = 20,
    period_s: Annotated[float, typer.Option("--period", help="Seconds between checks.")] = 5.0,
    between_h: Annotated[float, typer.Option("--between", help="Hours between false alarms, as configured.")] = 100.0,
    output: Annotated[
        Path | None, typer.Option(help="Folder for alarms.json and delay.png.", metavar="DIR", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """How often the monitor accuses a mount that is right, and how soon it notices one that moved (drawn checks)."""
    from coec.cli import alarms as command

    options = command.Options(hours, steps, period_s, between_h, output, as_json)
    raise typer.Exit(command.run(options))


@app.command("paper")
def _paper(
    source: Source,
    output: Annotated[Path, typer.Option(help="Folder for the figures and report.json.", metavar="DIR")] = Path(
        "coec-paper"
    ),
    depth: Depth = None,
    objective: Annotated[str, typer.Option(help="mi (the paper's) or fused.", metavar="NAME")] = "mi",
    runs: Annotated[int, typer.Option(help="Solves per experiment.", min=1)] = 100,
    samples: Annotated[int, typer.Option(help="Samples of pairs for the failure metrics.", min=3)] = 100,
    frames: Frames = None,
    slice_s: Annotated[
        float | None, typer.Option(help="Cut the drive into windows of 25 pairs over so many seconds.", min=1.0)
    ] = None,
    as_json: Json = False,
) -> None:
    """Repeat the published experiments on a recording: metrics.png, bullseye.png, drive.png."""
    from coec.cli import paper as command

    options = command.Options(
        source=source,
        output=output,
        depth=depth,
        objective=objective,
        runs=runs,
        samples=samples,
        frames=frames,
        slice_s=slice_s,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("run")
def _run(
    config: ConfigFile,
    embedded_router: Annotated[
        bool, typer.Option("--embedded-router", help="Be the Zenoh router too, listening on `zenoh.listen`.")
    ] = False,
    state_dir: Annotated[Path | None, typer.Option(help="Instead of `state.directory`.", metavar="DIR")] = None,
) -> None:
    """Run the service until SIGTERM or SIGINT; SIGHUP reads the configuration again. Logs go to standard output."""
    from coec.cli import run as command

    raise typer.Exit(command.run(config, embedded_router=embedded_router, state_dir=state_dir))


@app.command("check-config")
def _check_config(
    file: Annotated[Path | None, typer.Argument(help="Configuration (YAML).", show_default=False)] = None,
    defaults: Annotated[bool, typer.Option("--defaults", help="Print a commented template instead.")] = False,
    as_json: Json = False,
) -> None:
    """Print the effective configuration with every default; exit 78 if it, or a file it names, cannot be used."""
    from coec.cli import check_config as command

    raise typer.Exit(command.run(file, defaults=defaults, as_json=as_json))


@app.command("doctor")
def _doctor(
    config: Annotated[
        Path | None,
        typer.Option(help="Configuration of the daemon (YAML).", metavar="FILE", show_default="/etc/coec/coec.yaml"),
    ] = None,
    seconds: Annotated[float, typer.Option(help="How long to listen to the streams.", min=0.5, max=600)] = 5.0,
    as_json: Json = False,
) -> None:
    """Find what stands between this computer and a calibration: exit 1 if something must be done first.

    Looks at the configuration, disk, clock, certificates, router, its rules, streams and the running service, if there
    is one; changes and disturbs nothing.
    """
    from coec.cli import doctor as command

    raise typer.Exit(command.run(command.Options(config=config, seconds=seconds, as_json=as_json)))


@app.command("play")
def _play(
    source: Source,
    config: Annotated[
        Path | None, typer.Option(help="Take the keys of the pair from this file.", metavar="FILE")
    ] = None,
    pair: Annotated[
        str | None,
        typer.Option(help="Pair of the configuration; without one, name in `sensors/<pair>/camera|lidar|ego`."),
    ] = None,
    middleware: Annotated[
        Middleware | None,
        typer.Option(
            help="native: frames on the keys of a pair. rmw_zenoh, ros2dds: a bag on its own topics, byte for byte; "
            "any other recording on those of the configuration's pair, or below `/<pair>/`.",
            show_default="that of --config, else native",
        ),
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", help="Of ROS 2, only these; comma between, or several times.", show_default="all"),
    ] = None,
    domain: Annotated[
        int | None,
        typer.Option(help="ROS_DOMAIN_ID (rmw_zenoh).", min=0, max=232, show_default="that of --config, else 0"),
    ] = None,
    rate: Annotated[float, typer.Option(help="Times recorded speed; 0 = without waiting.", min=0)] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="Again and again; sensor time goes on.")] = False,
    connect: Connect = None,
    encoding: Annotated[Encoding, typer.Option(help="Of the frames.")] = Encoding.MSGPACK,
    start_now: Annotated[bool, typer.Option("--start-now", help="Shift the stamps so that they begin now.")] = False,
    as_json: Json = False,
) -> None:
    """Publish a recording on Zenoh, as its sensors would have."""
    from coec.cli import play as command

    options = command.Options(
        source=source,
        config=config,
        pair=pair,
        middleware=None if middleware is None else middleware.value,
        topics=tuple(topic for given in topics or () for topic in given.split(",")),
        domain=domain,
        rate=rate,
        loop=loop,
        connect=connect,
        encoding="cdr" if encoding is Encoding.CDR else "msgpack",
        start_now=start_now,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("query")
def _query(
    key: Annotated[
        str,
        typer.Argument(
            help="extrinsic, health, history, windows, windows/ID, status, config, metrics, command/NAME, or a whole "
            "key expression with @v1 in it.",
            show_default=False,
        ),
    ],
    pair: Annotated[
        str | None, typer.Option(help="All pairs if not given; needed for commands if there are several.")
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="Of the service: names the vehicle, the prefix and the router.", metavar="FILE"),
    ] = None,
    vehicle: Annotated[str | None, typer.Option(show_default="vehicle")] = None,
    prefix: Annotated[str | None, typer.Option(show_default="coec")] = None,
    connect: Connect = None,
    zenoh: Annotated[
        Path | None,
        typer.Option(
            help="Zenoh configuration (JSON5) to connect with; with its certificate commands are proven.",
            metavar="FILE",
        ),
    ] = None,
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="Give a command without proof of who gives it.")
    ] = False,
    param: Annotated[
        list[str] | None, typer.Option(help="Parameter of the query, for example limit=5; repeatable.", metavar="K=V")
    ] = None,
    payload: Annotated[str | None, typer.Option(help="Payload of a command, JSON.")] = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait, for the router and for the answer.", min=0.01)] = 5.0,
    output: Annotated[
        Path | None, typer.Option(help="Download windows/ID into this file and verify its sha256.", metavar="FILE")
    ] = None,
    as_json: Json = False,
) -> None:
    """Ask a running service."""
    from coec.cli import query as command

    options = command.Options(
        key=key,
        pair=pair,
        service=command.asked_of(config, vehicle, prefix, connect, zenoh),
        params=tuple(param or ()),
        payload=payload,
        timeout_s=timeout,
        output=output,
        as_json=as_json,
        anonymous=anonymous,
    )
    raise typer.Exit(command.run(options))


@app.command("watch")
def _watch(
    config: Annotated[
        Path | None,
        typer.Option(help="Of the service: names the vehicle, the prefix and the router.", metavar="FILE"),
    ] = None,
    vehicle: Annotated[str | None, typer.Option(show_default="vehicle")] = None,
    prefix: Annotated[str | None, typer.Option(show_default="coec")] = None,
    connect: Connect = None,
    zenoh: Annotated[
        Path | None,
        typer.Option(help="Zenoh configuration of the session (JSON5): endpoint, certificate.", metavar="FILE"),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="For so long: exit 1 if nothing was heard.", min=0.1, show_default="for ever")
    ] = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for the router.", min=0.01)] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="A JSON document a line on standard output.")] = False,
) -> None:
    """Show health, extrinsic and presence of every pair of a running service, as they change; gives no command."""
    from coec.cli import query
    from coec.cli import watch as command

    options = command.Options(
        service=query.asked_of(config, vehicle, prefix, connect, zenoh),
        seconds=seconds,
        timeout_s=timeout,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("view")
def _view(
    source: Annotated[
        str | None, typer.Argument(metavar="SOURCE", help=f"Play this: {SOURCE_HELP}", show_default=False)
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="Instead, watch the running vehicle of this configuration.", metavar="FILE"),
    ] = None,
    pair: Annotated[str | None, typer.Option(help="Which pair of the configuration, where there are several.")] = None,
    connect: Connect = None,
    zenoh: Annotated[
        Path | None,
        typer.Option(help="Zenoh configuration of the session (JSON5): endpoint, certificate.", metavar="FILE"),
    ] = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for the router.", min=0.01)] = 5.0,
    result: Annotated[
        Path | None, typer.Option(help="Of `calibrate --json`: drawn as the candidate.", metavar="FILE")
    ] = None,
    rate: Annotated[float, typer.Option(help="Times recorded speed.", min=0.01, max=100)] = 1.0,
    repeat: Annotated[bool, typer.Option("--repeat", help="Again and again; sensor time goes on.")] = False,
    listen: Annotated[
        str, typer.Option(help="Where viewers are served; port 0 is any that is free.", metavar="HOST:PORT")
    ] = "127.0.0.1:8765",
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Also where other computers get in: without a certificate they see all.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the address and what is served as one JSON document.")
    ] = False,
) -> None:
    """Show a vehicle or a recording live in Foxglove or Lichtblick: image with points, cloud, frames, health.

    Needs the optional extra `foxglove`. Gives no command, and asks the vehicle for frames only while somebody looks.
    Whoever reaches the address sees all, and so does every web page that a browser of this computer has open.
    """
    from coec.cli import query
    from coec.cli import view as command

    place = command.place_of(listen, insecure=insecure)
    if (source is None) == (config is None):
        raise UsageError("coec view: give a SOURCE, or --config FILE, and not both")
    if config is not None:
        if result is not None or repeat or rate != 1.0:
            raise UsageError("--result, --rate and --repeat are about a SOURCE: a vehicle has its own")
        watched = command.VehicleOptions(config, query.asked_of(config, None, None, connect, zenoh), pair, timeout)
        raise typer.Exit(command.show_vehicle(watched, place, as_json=as_json))
    if pair is not None or connect is not None or zenoh is not None:
        raise UsageError("--pair, --connect and --zenoh are about a vehicle: they need --config FILE")
    played = command.RecordingOptions(source or "", result, rate, repeat)
    raise typer.Exit(command.show_recording(played, place, as_json=as_json))


@app.command("router")
def _router(
    config: Annotated[
        Path, typer.Option(help="Zenoh configuration of a router (JSON5).", metavar="FILE", show_default=False)
    ],
) -> None:
    """Be the Zenoh router of the vehicle, with the access control of its configuration (deploy/router.json5)."""
    from coec.cli import router as command

    raise typer.Exit(command.run(config))


@app.command("replay")
def _replay(
    window: Annotated[Path, typer.Argument(help="A recorded window with its result (.mcap).", show_default=False)],
    depth: Annotated[
        str | None, typer.Option(help="Where the depth network is now, if not where it was.", metavar="MODEL")
    ] = None,
    as_json: Json = False,
) -> None:
    """Reach the recorded decision again from the file alone; exit 1 if a byte of it differs."""
    from coec.cli import replay as command

    raise typer.Exit(command.run(window, depth=depth, as_json=as_json))


@app.command("convert")
def _convert(
    source: Source,
    out: Annotated[
        Path,
        typer.Argument(
            help="OUT.mcap: one ROS 2 MCAP of all frames. OUT.yaml: a daemon configuration for this recording.",
            show_default=False,
        ),
    ],
    as_json: Json = False,
) -> None:
    """Turn a recording into a ROS 2 MCAP, or into a configuration with which `run` serves it."""
    from coec.cli import convert as command

    raise typer.Exit(command.run(source, out, as_json=as_json))


network_models = typer.Typer(
    help="Depth networks: list the built-in model cards, show which card a file gets, assess one."
)
app.add_typer(network_models, name="models")


@network_models.callback(invoke_without_command=True)
def _models(context: typer.Context, as_json: Json = False) -> None:
    if context.invoked_subcommand is None:
        from coec.cli import models as command

        raise typer.Exit(command.run(as_json=as_json))


@network_models.command("show")
def _models_show(
    file: Annotated[Path, typer.Argument(help="An ONNX file.", metavar="FILE", show_default=False)],
    as_json: Json = False,
) -> None:
    """Show the model card that a network file is run by."""
    from coec.cli import models as command

    raise typer.Exit(command.show(file, as_json=as_json))


@network_models.command("assess")
def _models_assess(
    model: Annotated[
        str,
        typer.Argument(help="An ONNX file, a built-in name, or `stereo`.", metavar="MODEL", show_default=False),
    ],
    source: Source,
    frames: Frames = None,
    output: Annotated[
        Path | None, typer.Option(help="Write curves.png, joint.png, frame.png and report.json.", metavar="DIR")
    ] = None,
    as_json: Json = False,
) -> None:
    """Hold a depth network against the LiDAR of a calibrated recording: exit 1 if it is of no use there."""
    from coec.cli import assess as command

    options = command.Options(model=model, source=source, frames=frames, output=output, as_json=as_json)
    raise typer.Exit(command.run(options))


sim_app = typer.Typer(no_args_is_help=True, help="A vehicle that does not exist (optional extra `sim`).")
app.add_typer(sim_app, name="sim")

Seed = Annotated[int, typer.Option(help="Same seed, same bytes.", min=0)]
SimCamera = Annotated[
    str,
    typer.Option(
        help="fisheyeW (185°, W×W pixels), pinholeWxH (90° wide) or pinholeWxH@D (D degrees wide).", metavar="CAMERA"
    ),
]
SimScene = Annotated[str, typer.Option(help="street, highway, garage or room.", metavar="SCENE")]
SimSpeed = Annotated[
    float | None,
    typer.Option("--speed", help="Mean speed, m/s; 0 stands. Without it, as usual in the scene.", min=0, max=45),
]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        help="KIND:BEGIN[-END][:KEY=VALUE,...], repeatable: step:30:rx=3, drift:30-90:ry=2, dirt, dark, frozen, beams, "
        "no-ego, offset, offset_drift:10-60:seconds=0.05, loss; poor stretches: tunnel:20-35, open_road:20-50, "
        "night:20-60, rain:20-60:mmph=20, low_sun:20-60.",
        metavar="FAULT",
    ),
]


@sim_app.command("drive")
def _sim_drive(
    output: Annotated[
        Path,
        typer.Option(help="ROS 2 MCAP to write; of a rig, the folder.", metavar="FILE.mcap|DIR", show_default=False),
    ],
    rig: Annotated[
        str | None,
        typer.Option(
            help="Several cameras and LiDARs on one vehicle: four-fisheyes. A fault then begins with the sensor's "
            "name: front:step:40:ry=1, roof:step:40:rz=1, about the sensor's own axes.",
            metavar="RIG",
        ),
    ] = None,
    seed: Seed = 0,
    seconds: Annotated[float, typer.Option(help="Length of the drive.", min=0.1)] = 60.0,
    camera: SimCamera = "fisheye700",
    lidar: Annotated[
        str, typer.Option(help="Beams: 16, 32, 64, 128; or without rings: raster, rosette.", metavar="LIDAR")
    ] = "64",
    scene: SimScene = "street",
    speed_mps: SimSpeed = None,
    rolling_shutter_s: Annotated[
        float, typer.Option("--rolling-shutter", help="Seconds from the first row to the last.", min=0, max=0.1)
    ] = 0.0,
    intrinsics_off: Annotated[
        str | None,
        typer.Option(
            help="What the rig is told of the focal length and the principal point is wrong by so many percent.",
            metavar="FOCAL[,CX,CY]",
        ),
    ] = None,
    camera_hz: Annotated[float, typer.Option(help="Pictures per second.", min=0.01)] = 10.0,
    lidar_hz: Annotated[float, typer.Option(help="Sweeps per second.", min=0.01, max=10)] = 10.0,
    fault: Faults = None,
    workshop: Annotated[
        str | None,
        typer.Option(
            help="Error of the nominal calibration, degrees and metres; of a rig SENSOR:RX,RY,RZ;...",
            metavar="RX,RY,RZ[,TX,TY,TZ]",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a drive as a ROS 2 bag; the truth lies beside the sensors on /ground_truth/tf.

    A bag has no place for a mask: what reads it back finds the vehicle's own body and the rim of the lens from the
    frames themselves, given five or more in motion.
    """
    from coec.cli import sim as command

    options = command.Options(
        seed=seed,
        seconds=seconds,
        camera=camera,
        lidar=lidar,
        camera_hz=camera_hz,
        lidar_hz=lidar_hz,
        faults=tuple(fault or ()),
        workshop=workshop,
        scene=scene,
        speed_mps=speed_mps,
        rolling_shutter_s=rolling_shutter_s,
        intrinsics_off=intrinsics_off,
        rig=rig,
    )
    if rig is not None:
        from coec.cli import sim_rig

        raise typer.Exit(sim_rig.drive(options, output, as_json=as_json))
    raise typer.Exit(command.drive(options, output, as_json=as_json))


@sim_app.command("view")
def _sim_view(
    output: Annotated[Path, typer.Option(help="Picture to write.", metavar="FILE.jpg", show_default=False)],
    seed: Seed = 0,
    at_s: Annotated[float, typer.Option(help="Seconds into the drive.", min=0)] = 0.0,
    camera: SimCamera = "fisheye700",
    scene: SimScene = "street",
    speed_mps: SimSpeed = None,
    fault: Faults = None,
    as_json: Json = False,
) -> None:
    """Write one picture of a drive."""
    from coec.cli import sim as command

    options = command.Options(
        seed=seed, seconds=at_s + 1.0, camera=camera, scene=scene, speed_mps=speed_mps, faults=tuple(fault or ())
    )
    raise typer.Exit(command.view(options, at_s, output, as_json=as_json))


@sim_app.command("matrix")
def _sim_matrix(
    output: Annotated[
        Path,
        typer.Option(help="Folder for report.json, normalised.png and drives/.", metavar="DIR", show_default=False),
    ],
    only: Annotated[
        str | None,
        typer.Option(
            help="Drives whose name fits: scene_lens_lidar_light_fault_sN with * and ?, as '*_night_*' or '*_s1'.",
            metavar="PATTERN",
        ),
    ] = None,
    dof: Annotated[
        DegreesOfFreedom | None, typer.Option(help="Rotation only, or translation too.", show_default="both")
    ] = None,
    frames: Annotated[int, typer.Option(help="Pairs of a window; a drive has two windows.", min=2, max=100)] = 10,
    depth: Depth = None,
    jobs: Annotated[
        int | None, typer.Option(help="Processes, of one core and 1 GB each.", min=1, show_default="the cores")
    ] = None,
    as_json: Json = False,
) -> None:
    """Try estimator and monitor on simulated drives that nobody tuned to: scenes, lenses, LiDARs, light, faults.

    A drive takes about half a minute of one core, the whole matrix most of an hour. What is done is kept in DIR: call
    again to go on. A DIR holds results of one state of the code; take another after a change.
    """
    from coec.cli import sim_matrix as command

    options = command.Options(
        output=output,
        only=only,
        dof=None if dof is None else int(dof.value),
        frames=frames,
        depth=depth,
        jobs=jobs,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@sim_app.command("checks")
def _sim_checks(
    output: Annotated[
        Path, typer.Option(help="Folder for report.json and drives/.", metavar="DIR", show_default=False)
    ],
    rounds: Annotated[
        int, typer.Option(help="Drives in every place with every rig, each of another seed.", min=1, max=10_000)
    ] = 4,
    hours: Annotated[
        float, typer.Option(help="Hours of driving to resample from them, whole drives at a time.", min=0, max=10_000)
    ] = 100.0,
    as_json: Json = False,
) -> None:
    """Tell how often the monitor accuses a right mount on rendered drives, and how soon it notices a wrong one.

    A drive is 25 s of one rig in one place, looked at from the truth and from beside it; it takes a quarter of a minute
    of one core, a round 40 of them. What no drive met is told by a tail that is fitted to how far off places are. What
    is done is kept in DIR: call again, with more rounds, to go on. A DIR holds results of one state of the code.
    """
    from coec.cli import sim_checks as command

    raise typer.Exit(command.run(command.Options(output, rounds, hours, as_json=as_json)))


@sim_app.command("rig-moves")
def _sim_rig_moves(
    drives: Annotated[int, typer.Option(help="Drives of each fault.", min=1, max=10_000)] = 30,
    rigs: Annotated[int, typer.Option(help="Rigs whose windows are combined.", min=1, max=10_000)] = 50,
    as_json: Json = False,
) -> None:
    """Tell how well the sensors of a rig that moved are named, and no others, on drawn evidence of all its pairs.

    Nothing is rendered: checks and windows are drawn with all that is wrong with real ones. A drive takes one to three
    seconds of a core.
    """
    from coec.cli import sim_rig_moves as command

    raise typer.Exit(command.run(drives, rigs, as_json=as_json))


@sim_app.command("rig-drives")
def _sim_rig_drives(
    output: Annotated[
        Path, typer.Option(help="Folder for report.json and drives/.", metavar="DIR", show_default=False)
    ],
    drives: Annotated[int, typer.Option(help="Drives, each with every fault.", min=1, max=10_000)] = 30,
    camera: Annotated[str, typer.Option(help="Of every camera of the rig, fisheyeW.", metavar="NAME")] = "fisheye700",
    as_json: Json = False,
) -> None:
    """Tell how well the sensors of a rig that moved are named, and no others, on rendered drives.

    A drive is a minute and a half of a street with four fisheyes and a LiDAR, drawn as the rig was built and with two
    cameras and the LiDAR knocked by 1°; it takes some minutes of one core. Of the pictures those rows are drawn that
    the LiDAR sees. What is done is kept in DIR: call again, with more drives, to go on. A DIR holds results of one
    state of the code.
    """
    from coec.cli import sim_rig_drives as command

    raise typer.Exit(command.run(command.Options(output, drives, camera, as_json=as_json)))


@app.command("sbom")
def _sbom(
    lock: Annotated[
        Path | None,
        typer.Option(help="The requirements.lock of the installation: hashes come from it.", metavar="FILE"),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Write coec.cdx.json and licences.md.", metavar="DIR")] = None,
    as_json: Json = False,
) -> None:
    """Tell what this installation is made of: a table of licences, with --json a bill of materials (CycloneDX)."""
    from coec.cli import sbom as command

    raise typer.Exit(command.run(lock, output, as_json=as_json))


@app.command("bench")
def _bench(as_json: Json = False) -> None:
    """Measure the speed of the kernels and of a solve on this machine, beside plain forms in the same run."""
    from coec.cli import bench as command

    raise typer.Exit(command.run(as_json=as_json))


@app.command("check")
def _check(source: Source, depth: Depth = None, as_json: Json = False) -> None:
    """What a recording holds, and what it is good for: exit 1 if no calibration can come of it."""
    from coec.cli import check as command

    raise typer.Exit(command.run(source, depth=depth, as_json=as_json))


@app.command("lidars")
def _lidars(
    source: Annotated[
        str,
        typer.Argument(help="A ROS 2 bag, or sim:rig=four-fisheyes&seconds=60.", metavar="SOURCE", show_default=False),
    ],
    a: Annotated[
        str, typer.Argument(help="Topic (of a rig, name) of the denser LiDAR.", metavar="A", show_default=False)
    ],
    b: Annotated[str, typer.Argument(help="Of the one whose pose in A is told.", metavar="B", show_default=False)],
    pairs: Annotated[int, typer.Option(help="Pairs of sweeps, evenly over the recording.", min=1, max=200)] = 12,
    as_json: Json = False,
) -> None:
    """Where one LiDAR of a vehicle sits from another, of the surfaces that both see: exit 1 if those are too few."""
    from coec.cli import lidars as command

    raise typer.Exit(command.run(command.Options(source, a, b, pairs, as_json)))


@app.command("export")
def _export(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A state directory, a recorded window (.mcap), the JSON of `calibrate` or of `query extrinsic`.",
            show_default=False,
        ),
    ],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help="tf, urdf, autoware, kalibr, kitti, kitti360, nuscenes, openlabel, colmap, opencv or json.",
            metavar="NAME",
            show_default=False,
        ),
    ],
    parent: Annotated[str | None, typer.Option(help="Frame to write it in.", show_default="the LiDAR's")] = None,
    child: Annotated[str | None, typer.Option(help="Frame of the camera.", show_default="the camera's")] = None,
    parent_pose: Annotated[
        str | None,
        typer.Option(
            help="Pose of the LiDAR in the parent: metres and a quaternion.",
            metavar="X,Y,Z,QX,QY,QZ,QW",
            show_default="the LiDAR is the parent",
        ),
    ] = None,
    pair: Annotated[str | None, typer.Option(help="Which pair, where there are several.")] = None,
    config: Annotated[
        Path | None, typer.Option(help="Configuration of the daemon, for intrinsics and frames.", metavar="FILE")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            help="Write there, at once or not at all; of a file that holds others, this entry alone is changed. "
            "Otherwise it is printed.",
            metavar="FILE",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Also what is not accepted; the file says so.")] = False,
    as_json: Json = False,
) -> None:
    """Write a calibration into the files of other programs: exit 1 if it is not accepted."""
    from coec.cli import export as command

    options = command.Options(
        source=source,
        format=form,
        parent=parent,
        child=child,
        parent_pose=parent_pose,
        pair=pair,
        config=config,
        output=output,
        force=force,
        as_json=as_json,
    )
    raise typer.Exit(command.run(options))


@app.command("demo")
def _demo(
    output: Annotated[Path, typer.Option(help="Folder for pictures, window and result.", metavar="DIR")] = Path(
        "coec-demo"
    ),
    rig: Annotated[
        bool,
        typer.Option(
            "--rig",
            help="Of a vehicle with four cameras: a knocked LiDAR and a knocked camera, told apart. Pictures have 700 "
            "pixels a side; what looks and tells is the service's, here without the service around it.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """A simulated vehicle whose mount is knocked, and the service that notices and repairs it: no data, two minutes."""
    from coec.cli import demo as command
    from coec.cli.demo import rig as of_rig

    raise typer.Exit((of_rig if rig else command).run(output, as_json=as_json))


def main() -> int:
    """Entry point; returns the exit status."""
    as_json = "--json" in sys.argv[1:]
    try:
        app()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else 0
        if status == UsageError.exit_code and as_json:
            _print_error("bad_request", "the command line does not fit; standard error says how")
        return status
    except CoecError as error:
        print(f"coec: {error}", file=sys.stderr)
        if as_json:
            _print_error(error.reply_code, str(error))
        return error.exit_code
    except BrokenPipeError:
        # Whoever read our output has gone; nobody is left to be told, also not by the interpreter at its exit.
        sys.stdout = None
        return BROKEN_PIPE
    except Exception as error:
        import traceback

        traceback.print_exc()
        if as_json:
            _print_error("internal", f"{type(error).__name__}: {error}")
        return FAULT
    return 0


def _print_error(code: str, message: str) -> None:
    import json

    print(json.dumps({"error": {"code": code, "message": message}}, ensure_ascii=False))
