"""Opens a page on which characters are steered: keys, mouse, and all settings.

W A S D or the arrows walk, Shift runs, Q and E turn on the spot, 1 to 9 choose a style;
a click or a drag on the ground sends the character there, clicks with Shift along
waypoints.

Examples:
  python experiments/steer.py
  python experiments/steer.py --run runs/smgdiff --characters 4
  python experiments/steer.py --rig hero.glb
"""

import asyncio
import dataclasses
import functools
import time
import webbrowser
from collections.abc import Callable
from pathlib import Path

import jax
import tyro

import jaxmotion
from jaxmotion import cli, files
from jaxmotion.control.foot_lock import lock_feet
from jaxmotion.control.steering import Character, steered
from jaxmotion.export import rig, rig_mesh
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.viz import packed, page, viewer

# Those that are steered.
SHIPPED = tuple(
    name
    for name in ("locomotion", "locomotion_fast", "walker", "dribble")
    if name in files.SHIPPED
)


@dataclasses.dataclass(frozen=True)
class Config:
    """The command line.

    Attributes:
      run: Name of a shipped model, run folder of a system whose characters are
        steered (CAMDM, AAMDM, SMGDiff), or file of `camdm.py export`. The shipped
        models can be chosen on the page as well.
      rig: A .glb, .gltf or .vrm that is steered in the place of the mannequin; drawn at
        the size at which its legs are as long as the model's.
      roles: JSON file of the rig's joints by role, where names say too little.
      characters: To begin with, 1 to 64.
      host: Address to listen on. Anyone who reaches it can steer: there is no
        authentication.
      port: Port to listen on; 0 for any that is free.
      open: Open the page in a browser.
      out: Folder for takes that are recorded.
      cache: Folder where compiled programs are kept, for a faster next start.
      seed: Seeds starts and noise.
    """

    run: str = "locomotion"
    rig: cli.Optional[Path] = None
    roles: cli.Optional[Path] = None
    characters: int = 1
    host: str = "127.0.0.1"
    port: int = 8080
    open: bool = True
    out: Path = Path("runs/steer")
    cache: Path = Path.home() / ".cache" / "jaxmotion"
    seed: int = 0


def load(run: str) -> Character:
    """A model whose feet can be locked, if it has feet."""
    character = steered(jaxmotion.load(run, foot_lock=False), what=run)
    return lock_feet(character) if character.skeleton.feet else character


def dress(args: Config) -> tuple[Callable, Callable]:
    """What makes a model's body of the rig, and what saves takes of it.

    Raises:
      OSError, ValueError: if the file cannot be read, is no person's, or shows nothing.
    """
    found = rig.read_rig(args.rig)
    target = found.rest(args.roles)
    mesh = rig_mesh.rig_mesh(found)
    print(
        f"{args.rig}: {found.skeleton.num_joints} joints, {len(mesh.faces)} triangles"
    )

    def wear(character: Character, motion: Motion) -> viewer.Dress:
        function = jaxmotion.retarget(character.skeleton, target, motion=motion)
        scale = 1.0 / function.scale
        return viewer.Dress(
            skeleton=found.skeleton,
            wear=function.pose,
            scale=scale,
            packed=packed.pack(*rig_mesh.page_body(found, mesh, scale)),
        )

    def save(path: Path, skeleton: Skeleton, motion: Motion) -> None:
        if path.suffix != ".glb":
            return jaxmotion.save(path, skeleton, motion)
        path.parent.mkdir(parents=True, exist_ok=True)
        with files.replacing(path) as file:
            file.write(rig.to_glb(found, motion, rest=found.rest()))

    return wear, save


async def listen(args: Config, session: viewer.Session, save: Callable) -> None:
    """Serves until SIGINT or SIGTERM."""

    def ready(port: int) -> None:
        host = f"[{args.host}]" if ":" in args.host else args.host
        address = f"http://{host}:{port}"
        print(f"steer at {address} (Ctrl-C ends)", flush=True)
        if args.open:
            webbrowser.open(address)

    serve = page.Page(session, out=args.out, save=save, is_local=cli.is_local).serve
    await serve(args.host, args.port, stop=cli.until_stopped(), ready=ready)


def steer(args: Config) -> None:
    """Loads the model, opens the page, and lets people steer.

    Raises:
      OSError: if the model cannot be read or the address not be listened on.
      ValueError: if the model cannot be steered, or a package is missing.
    """
    cli.check(args)
    if args.characters > viewer.MOST_CHARACTERS:
        raise ValueError(
            f"--characters is {args.characters}, expected at most "
            f"{viewer.MOST_CHARACTERS}"
        )
    page.websockets()
    cli.check_address(args.host, args.port)
    if not jax.config.jax_compilation_cache_dir:
        jax.config.update("jax_compilation_cache_dir", str(args.cache))
    wear, save = (None, jaxmotion.save) if args.rig is None else dress(args)
    begin = time.perf_counter()
    first = load(args.run)
    print(f"{args.run} loaded in {time.perf_counter() - begin:.0f} s", flush=True)
    models = {args.run: lambda: first}
    models |= {x: functools.partial(load, x) for x in SHIPPED if x != args.run}
    session = viewer.Session(
        models,
        characters=args.characters,
        # Runs begin with what the network makes, as `jaxmotion.load` has it.
        foot_locks={args.run: args.run in SHIPPED},
        dress=wear,
        seed=args.seed,
    )
    asyncio.run(listen(args, session, save))


def main() -> None:
    """Parses the command line and lets people steer."""
    steer(tyro.cli(Config, description=__doc__))


if __name__ == "__main__":
    cli.start(main)
