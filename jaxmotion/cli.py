"""How a script starts and ends: options in range; one line for bad input."""

import asyncio
import contextlib
import dataclasses
import functools
import ipaddress
import operator
import os
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import jax
import tyro
from jax.errors import JaxRuntimeError
from jax.experimental import multihost_utils
from jax.extend.backend import clear_backends

from jaxmotion.learning.loop import TrainingDiverged, check_writable

Arguments = TypeVar("Arguments")
Value = TypeVar("Value")
# An option that may be left out, and several names: in one line of the help.
Optional = Annotated[Value | None, tyro.conf.arg(metavar="X", help_behavior_hint="")]
Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="...")]
# See `join_processes`.
Distributed = Annotated[tuple[str, ...], tyro.conf.arg(metavar="...")]


@dataclasses.dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high` that an option may have, but for those `without`."""

    low: float | int
    high: float | int
    without: tuple[int, ...] = ()

    def __contains__(self, value: float | int) -> bool:
        return self.low <= value <= self.high and value not in self.without

    def __str__(self) -> str:
        left = "(" if self.low in self.without else "["
        right = ")" if self.high in self.without else "]"
        return f"{left}{self.low:g}, {self.high:g}{right}"


_COUNT, _UPDATES, _SIZE = Range(1, 10**6), Range(1, 10**9), Range(1, 2**16)
_RATE, _FPS = Range(0, 1, (0,)), Range(0, 1000, (0,))
_PART, _SPAN = Range(0, 1, (0, 1)), Range(0, 86400, (0,))

_METERS = Range(0, 1000, (0,))

# Numbers of all scripts' options, by name. An option has None for its default, so that
# 0 is a number like others: allowed only where the help says what it means.
LIMITS: dict[str, Range] = {
    # Larger ones are not told apart: keys have 32 bits, and seeds are counted on.
    "seed": Range(0, 2**31 - 1),
    "port": Range(0, 65535),
    "max_clients": Range(1, 1000),
    "devices": Range(1, 10**4),
    **dict.fromkeys(("seeds", "most", "cores"), Range(1, 1000)),
    **dict.fromkeys(("held_out",), _PART),
    **dict.fromkeys(("learning_rate", "ddpm_rate", "discriminator_rate"), _RATE),
    **dict.fromkeys(("dropout", "ema", "alone"), Range(0, 1, (1,))),
    **dict.fromkeys(("fps", "cut_fps"), _FPS),
    **dict.fromkeys(("seconds", "minutes", "limit", "longest"), _SPAN),
    **dict.fromkeys(("rate", "off_ball", "own_levels", "cubic_wishes"), Range(0, 1)),
    **dict.fromkeys(("last_sigma", "max_distance", "tolerance"), _METERS),
    **dict.fromkeys(("scale", "amdm_scale", "recon"), Range(0, 10**6)),
    **dict.fromkeys(("max_norm", "previous_noise"), Range(0, 10**6)),
    **dict.fromkeys(("weight_position", "weight_velocity"), Range(0, 10**6)),
    "weight_position_velocity": Range(0, 10**6),
    "weight_acceleration": Range(0, 10**6),
    **dict.fromkeys(("weight_foot", "weight_pose"), Range(0, 10**6)),
    **dict.fromkeys(("speed", "speeds", "course_speeds"), Range(0, 100)),
    "toe_height": Range(-1000, 1000),
    "noise_half_life": Range(0, 86400),
    "min_acceleration": Range(0, 10**4),
    "before": Range(1, 86400),
    "long_minutes": Range(0, 86400),
    "warmup": Range(0, 10**9),
    "initial_scale": Range(0, 10),
    "draft_steps": Range(0, 10**9),
    **dict.fromkeys(("token_margin", "path_soon"), Range(0, 1000)),
    "channels": _SIZE,
    "frame_kernel": Range(0, 255),
    "seam_half_life": Range(0, 10**6),
    **dict.fromkeys(("noise_levels", "guided_steps"), Range(1, 1000)),
    "gan_window": Range(3, 1000),
    "given": Range(1, 10),
    "smooth": Range(0, 100),
    "window": Range(1, 1000),
    "balance": Range(0, 1),
    "loops": Range(2, 3600),
    **dict.fromkeys(("diffusion_steps", "visit", "visits"), Range(1, 1000)),
    "depth": Range(1, 256),
    "crossing": Range(0, 10**4),
    "frames": Range(2, 10**5),
    "heads": Range(1, 1024),
    **dict.fromkeys(("width", "hidden", "discriminator_width"), _SIZE),
    **dict.fromkeys(("batch", "polisher_batch", "chunk", "save_every"), _COUNT),
    **dict.fromkeys(("frames_per_token", "least", "length", "sequences"), _COUNT),
    **dict.fromkeys(("characters", "samples", "windows", "starts"), _COUNT),
    **dict.fromkeys(("repeats", "latents"), _COUNT),
    **dict.fromkeys(("rollouts", "long_rollouts", "draws", "sprint_draws"), _COUNT),
    **dict.fromkeys(("replications", "long_replications"), _COUNT),
    **dict.fromkeys(("steps", "updates", "path_steps", "window_steps"), _UPDATES),
    **dict.fromkeys(("autoencoder_steps", "polisher_steps"), _UPDATES),
    **dict.fromkeys(("generator_steps", "amdm_steps", "full_pose_steps"), _UPDATES),
    **dict.fromkeys(("ddpm_steps", "evaluator_steps"), _UPDATES),
}


def check(args: Arguments) -> Arguments:
    """Raises for an option out of range, before any work; None stands for a default.

    The `ValueError` names the option, its value and what is expected.
    """
    for field in dataclasses.fields(args):  # pyright: ignore[reportArgumentType]
        value = getattr(args, field.name)
        if field.name == "rows" and not value:
            raise ValueError('--rows is empty, expected names of rows, or "all"')
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, bool) or not isinstance(one, int | float):
                continue
            if one not in (limits := LIMITS[field.name]):
                option = field.name.replace("_", "-")
                raise ValueError(f"--{option} is {one}, expected a number in {limits}")
    return args


Commands = Mapping[str, tuple[type, Callable[[Any], None]]]


def kind_of(commands: Commands) -> Any:
    """What `tyro` reads for a script of several commands: one of their options."""
    kinds = [
        Annotated[kind, tyro.conf.subcommand(name)]
        for name, (kind, _) in commands.items()
    ]
    return functools.reduce(operator.or_, kinds)


def run(commands: Commands, text: str) -> None:
    """Parses the command line of a script of several commands, and runs one.

    By their names, each has the dataclass of its options and what it does.
    """
    args = check(tyro.cli(kind_of(commands), description=text))
    dict(commands.values())[type(args)](args)


def given(kind: type, args: Any) -> dict[str, Any]:
    """Values by name, for `kind(**...)`: options that are its fields, but for None."""
    names = {field.name for field in dataclasses.fields(kind)}
    return {k: x for k, x in vars(args).items() if k in names and x is not None}


def chosen_rows(args: Any, every: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Names of `args.rows`; `every` for "all", none for "none"."""
    words = {("all",): every, ("none",): ()}
    return words.get(args.rows, args.rows)


def out_folder(args: Any, name: str) -> Path:
    """Folder that a command writes to: `args.out`, or one of that name in `args.run`.

    `OSError` if it cannot be written, before any work.
    """
    out = args.out or args.run / name
    check_writable(out)
    return out


def join_processes(distributed: tuple[str, ...]) -> None:
    """Joins the processes of one run, on one or several hosts; before all else of JAX.

    From then on the devices of all of them are JAX's, each process runs the same
    program, and the first one writes.

    Args:
      distributed: None for one process; "auto" where SLURM, Open MPI, Kubernetes or a
        TPU pod tells JAX all; otherwise the first process's address, such as
        "10.0.0.1:1234", the number of processes, and which one this is, from 0.

    Raises:
      ValueError: if it is none of these, or the others are not found.
    """
    given: dict[str, Any] = {}
    match distributed:
        case ():
            return
        case ("auto",):
            pass
        case (str(address), number, index) if (number + index).isdigit():
            given = dict(
                coordinator_address=address,
                num_processes=int(number),
                process_id=int(index),
            )
        case _:
            raise ValueError(
                f"--distributed {' '.join(distributed)}: expected auto, or an address "
                "with a port, the number of processes, and which one this is"
            )
    try:
        jax.distributed.initialize(**given)
        # They are together now; later one may be minutes behind another's compiler,
        # where connections between them would not wait so long.
        multihost_utils.sync_global_devices("joined")
    except (RuntimeError, ValueError, TypeError) as error:
        raise ValueError(f"--distributed {' '.join(distributed)}: {error}") from error


def part_processes() -> bool:
    """Ends the company of `join_processes`, when the work that they share is done.

    True for the first process, whose JAX has its own devices alone from here on; arrays
    made before are gone. The others have nothing left to do.
    """
    first = jax.process_index() == 0
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()
        clear_backends()
    return first


def announce(what: str, seconds: int) -> None:
    """Says what a silence of so many seconds on two CPU cores is for: "compiling"."""
    print(f"{what}, about {seconds} s", file=sys.stderr, flush=True)


def start(main: Callable[[], None]) -> None:
    """Runs a script.

    It exits with one line and status 1 after bad input, without a package of an extra,
    after a training that diverged, on a device without enough memory, or after another
    process died; with 130 after Ctrl-C.
    """
    known = (
        OSError,
        ValueError,
        ModuleNotFoundError,
        TrainingDiverged,
        JaxRuntimeError,
    )
    try:
        main()
    except known as error:
        text = f"error: {' '.join(str(error).split())}"
        if not jax.distributed.is_initialized():
            sys.exit(text)
        where = f"process {jax.process_index()} of {jax.process_count()}"
        print(f"{where}: {text}", file=sys.stderr, flush=True)
        # At once: to leave in order is to wait minutes for who may be dead.
        os._exit(1)
    except KeyboardInterrupt as stop:
        # Its text, if there is one, says where the state was saved.
        if str(stop):
            print(stop, file=sys.stderr)
        sys.exit(130)


def is_local(host: str | None) -> bool:
    """Whether only this machine reaches an address; False where it is not known."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host or "").is_loopback
    return host == "localhost"


def check_address(host: str, port: int) -> None:
    """Raises if an address cannot be listened on; before minutes of compiling.

    Warns where other machines may reach it; the `OSError` names the address.
    """
    if not is_local(host):
        print(
            f"warning: {host} may be reached from other machines, and there is no "
            "authentication: whoever connects can steer characters",
            file=sys.stderr,
            flush=True,
        )
    try:
        found = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        for family, kind, number, _, address in found:
            with socket.socket(family, kind, number) as probe:
                if sys.platform != "win32":
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
    except OSError as error:
        raise OSError(f"cannot listen on {host}:{port}: {error.strerror}") from error


def until_stopped() -> asyncio.Event:
    """What is set on SIGINT or SIGTERM; to be called in a running event loop."""
    stop = asyncio.Event()
    if sys.platform != "win32":  # where Ctrl-C cancels the caller instead
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop
