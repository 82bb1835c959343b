"""One sample of each system: ours against PyTorch, torch.compile, and onnxruntime.

Same parameters, same conditions, same number of threads, measured in turn in one run,
for a number of characters at a time. A sample is a plan of CAMDM or SMGDiff (without
contact guidance), a motion of EMDM, or a frame of AAMDM. The PyTorch side runs as the
released code does, every token in every step; onnxruntime runs our own sampler as
`experiments/export.py` writes it, several characters one after the other. Needs torch
(`pip install -e ".[parity]"`), and for onnxruntime `".[export]"`.

`experiments/report.py --keep runs/benchmarks/peers.json --name timings/peers` stores
what was measured.

Examples:
  python benchmarks/peers.py
  python benchmarks/peers.py --threads 1
  python benchmarks/peers.py --system aamdm emdm camdm smgdiff --batch 1 16 64 256 1024 --rounds 9 --limit 600
"""  # noqa: E501

import dataclasses
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import suite
import workload

from jaxmotion import cli
from jaxmotion.diffusion import noise
from jaxmotion.evaluation import timing
from jaxmotion.export import graph, onnx
from jaxmotion.typing import Exported

try:
    import torch
    import torch_peers
except ModuleNotFoundError as error:
    raise SystemExit(
        f'error: peers.py needs {error.name}: pip install -e ".[parity]"'
    ) from None

EAGER = "torch eager"
ONEDNN = "torch eager, products by oneDNN"
OURS = "ours, constants"
PREFIX = "ours, prefix attention"
COMPILED = "torch.compile"
ONNX = "onnxruntime"
COLUMNS = {
    "system": "system",
    "batch": "batch",
    "name": "",
    "rounds": "rounds",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "ratio": "/ eager",
    "ratio_spread": "spread",
    "cpu_ms": "cpu ms",
    "cpu_ratio": "/ eager",
    "cpu_spread": "spread",
}
# Cores of other processes up to which wall clock times of several threads count.
IDLE = 0.15
# Columns and rows of the stored table.
STORED = {
    OURS: "ours",
    PREFIX: "prefix",
    EAGER: "eager",
    ONEDNN: "onednn",
    COMPILED: "compile",
    ONNX: "onnx",
}
TITLES = {
    "aamdm": "AAMDM, a frame",
    "emdm": "EMDM, a motion of {} steps",
    "camdm": "CAMDM, a plan of {} steps",
    "smgdiff": "SMGDiff, a plan of {} steps",
}
# Rounds after which a row may sit out.
FEW = 7
# Milliseconds of a round that a row takes at least: quick calls are repeated.
LEAST = 10.0
# Whose encoder PyTorch can fuse, if the batch comes first, and ours can divide.
FUSED = ("camdm", "smgdiff")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Milliseconds of a batch of samples, and ratios to PyTorch in eager mode.

    Rows: ours with the parameters as arguments and as constants of the program; PyTorch
    eager as the released code lays it out (tokens first), the same with its own oneDNN
    in the place of MKL (half as fast as that on AMD's processors), for CAMDM's network
    also with the batch first (which lets PyTorch use its fused inference kernels), and
    through torch.compile, which compiles the network for each batch; our graph in
    onnxruntime.
    "Prefix attention" has the same parameters and is another function: networks are
    trained for it, as the shipped `locomotion` was.

    A ratio is the median over the rounds of ours / eager in the same round; its spread
    is from the 25th to the 75th percentile. It is compared by wall clock, on an idle
    machine: two threads that wait for each other suffer out of proportion when
    another process takes a core, PyTorch's much more than ours. With one thread it is
    compared by processor time, which hardly depends on the neighbors.

    Attributes:
      system: What to measure: camdm, smgdiff, emdm, aamdm.
      batch: Characters that are sampled together.
      steps: Diffusion steps; None for the paper's.
      width: Channels of a token or hidden layer; None for the system's own.
      paper: EMDM's published network, of 12 layers and 1024 channels, in the place of
        the one that experiments/emdm.py trains (4 layers, 128 channels, 4 frames a
        token).
      threads: Threads (and cores) of all.
      rounds: Timed rounds; each runs every row once.
      limit: Seconds of rounds of a system and a batch, at most, but one round.
      sit_out: After seven rounds rows of more than so many times our time sit out the
        rest; 0 for none.
      row_limit: Seconds of one call; a row that would take longer, judged by the batch
        before, is left out. 0 for no limit.
      round_limit: Seconds of one round; a batch whose round would take longer, judged
        by the one before, is left out. 0 for no limit.
      compile_limit: Seconds that torch.compile may take; 0 to leave it out.
      target: Greatest ratio of "ours, constants" that passes for one plan of CAMDM;
        exit status 1 beyond it, and 2 where the machine was too busy to tell. 0 for no
        target.
    """

    system: tuple[str, ...] = ("camdm",)
    batch: tuple[int, ...] = (1,)
    steps: int | None = None
    width: int | None = None
    paper: bool = False
    threads: int = 2
    rounds: int = 100
    limit: float = 120.0
    sit_out: float = 1.5
    row_limit: float = 60.0
    round_limit: float = 60.0
    compile_limit: int = 60
    target: float = 0.65


def use_cores(number: int) -> int:
    """Confines this process to so many cores, before jax starts its threads.

    Returns:
      Cores it has now: fewer if there are fewer, all where the system cannot do it.
    """
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    cores = sorted(os.sched_getaffinity(0))[:number]
    os.sched_setaffinity(0, cores)
    return len(cores)


def our_call(samples: workload.Samples, batch: int, *, arguments: bool) -> Callable:
    """Our compiled samples: parameters as arguments, or as constants."""
    program, given = samples.program(batch, chunk=samples.chunk, arguments=arguments)
    program, _ = timing.compile_program(program, *given)
    return lambda: program(*given)


def torch_call(
    peer: torch_peers.Peer, batch: int, given: tuple[torch.Tensor, ...]
) -> Callable:
    """PyTorch's samples, warm."""
    torch_peers.forward(peer, batch, given)
    return torch_peers.plan_call(peer, batch, given)


class TooLate(BaseException):
    """Not an `Exception`: compilers catch those, and go on."""


def compiled_call(
    peer: torch_peers.Peer, batch: int, given: tuple[torch.Tensor, ...], limit: int
) -> tuple[Callable | None, str]:
    """The same through torch.compile, if that works within `limit` seconds.

    Returns:
      The call, or None; and what happened, in words.
    """

    def stop(*_: Any) -> None:
        raise TooLate(f"not done within {limit} s")

    # Else it would make the next batch's size a variable of one slower program.
    torch._dynamo.reset()
    start = time.perf_counter()
    old = signal.signal(signal.SIGALRM, stop)
    signal.alarm(limit)
    try:
        call = torch_call(torch_peers.compiled(peer), batch, given)
    except (Exception, TooLate) as error:  # whatever it is: the rest still counts
        return None, f"torch.compile: {type(error).__name__}: {error}".split("\n")[0]
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
    return call, f"torch.compile took {time.perf_counter() - start:.0f} s"


def first(tree: Any) -> Any:
    """The first character's."""
    return jax.tree.map(lambda x: x[0], tree)


@dataclasses.dataclass(frozen=True)
class Player:
    """Our sampler in onnxruntime: for one character, and in a loop over several."""

    graph: graph.Graph
    one: Any
    any: Any

    def run(self, tape: Any, conditions: Any) -> np.ndarray:
        """Samples from given noise, batch axis first."""
        arrays = [np.asarray(x) for x in jax.tree.leaves((tape, conditions))]
        batch = arrays[0].shape[0]
        if batch == 1:
            arrays = [np.asarray(x[0]) for x in arrays]
        names = [port.name for port in self.graph.inputs]
        session = self.one if batch == 1 else self.any
        # Inputs that the result does not depend on may be gone.
        known = {x.name for x in session.get_inputs()}
        feed = dict(zip(names, arrays, strict=True))
        (found,) = session.run(None, {k: v for k, v in feed.items() if k in known})
        return found[None] if batch == 1 else found

    def call(self, batch: int, conditions: Any) -> Callable[[], np.ndarray]:
        """A batch of samples, with its own noise drawn in the call as ours is."""
        rng = np.random.default_rng(0)
        shapes = [
            (batch, *port.shape)
            for port in self.graph.inputs
            if port.name.startswith("noise")
        ]

        def call() -> np.ndarray:
            tape = [rng.standard_normal(shape, np.float32) for shape in shapes]
            return self.run(tape, conditions)

        return call


def make_player(
    samples: workload.Samples, *, threads: int, several: bool
) -> tuple[Player | None, str]:
    """Our sampler in onnxruntime, if its packages are there.

    Returns:
      The player, or None; and what happened, in words.
    """
    begun = time.perf_counter()
    try:
        onnx.check()
        sample = Exported(
            samples.sampler(samples.params), ("key", "condition"), ("sample",)
        )
        made = graph.make("sample", sample, {"condition": first(samples.conditions(1))})
        sessions = []
        with tempfile.TemporaryDirectory() as folder:
            for batch in (None, graph.ANY)[: 1 + several]:
                path = Path(folder) / f"sample{onnx.SUFFIX}"
                onnx.write(path, made, batch=batch)
                sessions.append(onnx.open_session(path.read_bytes(), threads=threads))
    except ValueError as error:
        return None, f"onnxruntime: left out: {error}"
    player = Player(made, sessions[0], sessions[-1])
    return player, f"onnxruntime: graphs took {time.perf_counter() - begun:.0f} s"


def largest_differences(
    samples: workload.Samples,
    peer: torch_peers.Peer,
    given: tuple[torch.Tensor, ...],
    player: Player | None,
) -> dict[str, float]:
    """Largest absolute differences from our sample, made from the same noise."""
    sample, conditions = samples.sampler(samples.params), samples.conditions(1)
    tape = noise.draw_noise(sample, jax.random.key(2), first(conditions))
    ours = jax.jit(noise.with_noise(sample))(tape, first(conditions))
    tape = jax.tree.map(lambda x: x[None], tape)

    def theirs() -> torch.Tensor:
        with torch.inference_mode():
            return torch_peers.sample(peer, *torch_peers.from_tape(tape), given)

    found = {EAGER: theirs().numpy()}
    if torch_peers.HAS_ONEDNN:
        found[ONEDNN] = torch_peers.with_onednn(theirs)().numpy()
    if player is not None:
        found[ONNX] = player.run(tape, conditions)
    difference = lambda x: float(np.abs(x[0] - np.asarray(ours)).max())  # noqa: E731
    return {name: difference(value) for name, value in found.items()}


def time_rows(
    calls: dict[str, Callable], args: Config, *, warmup: int
) -> dict[str, np.ndarray]:
    """Times in turn; far slower rows sit out after some rounds, as `sit_out` says.

    A row of a round is the mean of as many calls as take `LEAST`.
    """
    begun = time.perf_counter()
    few = min(FEW, args.rounds) if args.sit_out else args.rounds
    once = timing.time_in_turn(calls, rounds=1, warmup=warmup, least=1)
    many = {name: math.ceil(LEAST / max(once[name].min(), 0.1)) for name in calls}

    def repeated(call: Callable, number: int) -> Callable:
        def run() -> None:
            for _ in range(number):
                jax.block_until_ready(call())

        return run

    def in_turn(names: Iterable[str], **options: Any) -> dict[str, np.ndarray]:
        some = {name: repeated(calls[name], many[name]) for name in names}
        found = timing.time_in_turn(some, least=1, **options)
        return {name: values / many[name] for name, values in found.items()}

    times = in_turn(calls, rounds=few, warmup=0, limit_s=args.limit)
    most = args.sit_out * np.median(times[OURS], axis=0)
    stay = [name for name in calls if not np.all(np.median(times[name], axis=0) > most)]
    left = args.limit - (time.perf_counter() - begun)
    if len(times[OURS]) < few or few == args.rounds or left <= 0:
        return times
    more = in_turn(stay, rounds=args.rounds - few, warmup=0, limit_s=left)
    return times | {name: np.concatenate([times[name], more[name]]) for name in more}


def rows_of(times: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Percentiles and ratios to eager PyTorch, by wall clock and by processor time."""
    rows = []
    for name, values in times.items():
        rounds = min(len(values), len(times[EAGER]))
        ratio = values[:rounds] / times[EAGER][:rounds]
        low, middle, high = np.percentile(ratio, [25, 50, 75], axis=0)
        p50, p95 = np.percentile(values, [50, 95], axis=0)
        p25, p75 = np.percentile(values[:, 0], [25, 75])
        rows.append(
            {
                "name": name,
                "rounds": len(values),
                "p50_ms": float(p50[0]),
                "p95_ms": float(p95[0]),
                "middle_half": [float(p25), float(p75)],
                "ratio": float(middle[0]),
                "ratio_spread": f"{low[0]:.2f}-{high[0]:.2f}",
                "cpu_ms": float(p50[1]),
                "cpu_ratio": float(middle[1]),
                "cpu_spread": f"{low[1]:.2f}-{high[1]:.2f}",
            }
        )
    return rows


def faster(rows: list[dict[str, Any]]) -> list[str]:
    """What is faster than the faster of our two rows."""
    own = [row for row in rows if row["name"].startswith("ours")]
    ours = min(row["p50_ms"] for row in own if row["name"] != PREFIX)
    others = [row for row in rows if row not in own]
    return [row["name"] for row in others if row["p50_ms"] < ours]


def check_target(
    row: dict[str, Any], target: float, *, threads: int, load: float | None
) -> None:
    """Says whether the target is reached.

    Args:
      row: Row of `rows_of`.
      target: Greatest ratio that passes.
      threads: Threads of both sides; one is compared by processor time.
      load: Cores that other processes kept busy meanwhile; None if unknown.

    Raises:
      SystemExit: with status 1 if it is not, 2 if nothing can be said.
    """
    if threads > 1 and (load or 0.0) > IDLE:
        print(
            f"Not compared: other processes used {load} cores during the rounds. Run "
            "it on an idle machine, or with --threads 1."
        )
        raise SystemExit(2)
    ratio = row["ratio"] if threads > 1 else row["cpu_ratio"]
    passed = ratio <= target
    print(
        f"ratio {ratio:.2f}, at most {target:.2f}: {'passed' if passed else 'FAILED'}"
    )
    if not passed:
        raise SystemExit(1)


def calls_of(
    system: str,
    samples: workload.Samples,
    prefix: workload.Samples | None,
    peers: dict[str, torch_peers.Peer],
    player: Player | None,
    *,
    batch: int,
    skip: tuple[str, ...],
    compile_limit: int,
) -> tuple[dict[str, Callable], str]:
    """The rows of a batch but those to skip; and what happened to torch.compile."""
    conditions = samples.conditions(batch)
    given = torch_peers.given_of(system, samples.config, conditions)
    calls, note = {}, "torch.compile: left out"
    calls[OURS] = our_call(samples, batch, arguments=False)
    if batch == 1:
        calls["ours, arguments"] = our_call(samples, batch, arguments=True)
    if prefix is not None:
        calls[PREFIX] = our_call(prefix, batch, arguments=False)
    for name, peer in peers.items():
        if name not in skip and (name == EAGER or batch == 1):
            calls[name] = torch_call(peer, batch, given)
    if torch_peers.HAS_ONEDNN and ONEDNN not in skip:
        calls[ONEDNN] = torch_peers.with_onednn(torch_call(peers[EAGER], batch, given))
    if compile_limit and COMPILED not in skip:
        call, note = compiled_call(peers[EAGER], batch, given, compile_limit)
        if call is not None:
            calls[COMPILED] = call
    if player is not None and ONNX not in skip:
        calls[ONNX] = player.call(batch, conditions)
    return calls, note


def measure(
    system: str, args: Config, *, threads: int
) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of a system, and what else there is to say of them."""
    sizes = workload.Sizes(
        steps=args.steps, width=args.width, paper=args.paper and system == "emdm"
    )
    make, prefix = workload.of(system, "samples"), None
    samples = make(sizes)
    if system in FUSED:
        prefix = make(dataclasses.replace(sizes, attention="prefix"))
    layouts = {EAGER: False} | (
        {f"{EAGER}, batch first": True} if system in FUSED else {}
    )
    peers = {
        name: torch_peers.make(
            system, samples.config, samples.params, batch_first=layout
        )
        for name, layout in layouts.items()
    }
    player, note = make_player(samples, threads=threads, several=max(args.batch) > 1)
    given = torch_peers.given_of(system, samples.config, samples.conditions(1))
    differences = largest_differences(samples, peers[EAGER], given, player)
    text = ", ".join(f"{name} {value:.1e}" for name, value in differences.items())
    print(f"{system}: samples from one noise differ from ours by {text}; {note}")
    rows, notes = [], [note]
    before: dict[str, float] = {}
    for batch in sorted(args.batch):
        # Milliseconds to be expected, by the batch before.
        factor = batch / max((row["batch"] for row in rows), default=batch)
        expected = {name: factor * value for name, value in before.items()}
        skip = tuple(
            name
            for name, value in expected.items()
            if args.row_limit and value > 1000 * args.row_limit
            if name != EAGER and not name.startswith("ours")
        )
        seconds = sum(expected.values()) / 1000
        if args.round_limit and seconds > args.round_limit:
            text = f"a round of {seconds:.0f} s, --round-limit {args.round_limit:g} s"
            print(f"{system}, batch {batch}: left out: {text}")
            break
        if skip:
            text = f"more than --row-limit {args.row_limit:g} s a call"
            print(f"{system}, batch {batch}: {', '.join(skip)} left out: {text}")
        calls, note = calls_of(
            system,
            samples,
            prefix,
            peers,
            player,
            batch=batch,
            skip=skip,
            compile_limit=args.compile_limit,
        )
        notes.append(f"batch {batch}: {note}")
        since = suite.busy()
        # After the first batch no call is the first of its network any more.
        times = time_rows(calls, args, warmup=1 if seconds > 1 else 3)
        load = suite.other_load(since)
        found = rows_of(times)
        before = {row["name"]: row["p50_ms"] for row in found}
        title = TITLES[system].format(samples.config.num_steps)
        own = dict(system=system, title=title, batch=batch, load=load)
        found = [own | row for row in found]
        rows += found
        print(f"{system}, batch {batch}: {threads} threads; {note}", flush=True)
        suite.print_table(found, COLUMNS)
        if faster(found):
            print(f"faster than ours: {', '.join(faster(found))}")
    return rows, {"largest_differences": differences, "notes": notes}


def metric_of(row: dict[str, Any]) -> suite.Metric:
    """A row's cell of the stored table, with the middle half of its rounds."""
    low, high = row["middle_half"]
    return suite.Metric(
        f"{row['title']}, batch {row['batch']} {STORED[row['name']]}",
        row["p50_ms"],
        "ms",
        low=low,
        high=high,
        samples=row["rounds"],
    )


def main() -> None:
    """Measures, writes the report, and checks the target."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, batch=1, steps=1, threads=1, rounds=1)
    for system in args.system:
        workload.of(system, "samples")
    threads = use_cores(args.threads)
    torch.set_num_threads(threads)
    rows, about = [], {}
    for system in dict.fromkeys(args.system):
        found, about[system] = measure(system, args, threads=threads)
        rows += found
    metrics = [metric_of(row) for row in rows if row["name"] in STORED]
    suite.write_table(args.out / "peers", rows, COLUMNS)
    suite.report(
        "peers",
        metrics,
        args,
        rows=rows,
        threads=threads,
        systems=about,
    )
    for row in rows:
        if args.target and (row["system"], row["batch"]) == ("camdm", 1):
            if row["name"] == OURS:
                check_target(row, args.target, threads=threads, load=row["load"])


if __name__ == "__main__":
    cli.start(main)
