"""How a script ends: with one line for bad input, not with a traceback."""

import sys
from collections.abc import Callable

from jaxmotion.learning.loop import TrainingDiverged


def start(main: Callable[[], None]) -> None:
    """Runs a script.

    Args:
      main: The script.

    Raises:
      SystemExit: with one line and status 1 after bad input or a training that
        diverged; with status 130 after Ctrl-C.
    """
    try:
        main()
    except (OSError, ValueError, TrainingDiverged) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt as stop:
        # Its text, if there is one, says where the state was saved.
        if str(stop):
            print(stop, file=sys.stderr)
        sys.exit(130)
