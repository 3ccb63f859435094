"""Run a training in a forked process that exits without cleanup at a chosen write, as under SIGKILL."""

import os
from collections.abc import Callable


def killed(training: Callable[[], object], write: int, *, before: bool) -> bool:
    """Run a training in a fork that dies at its n-th write of a file; return True if it died before its end.

    write: number n of the write, from 1. before: die just before the write, otherwise just after it.
    """
    child = os.fork()
    if child == 0:  # pragma: no cover
        replace, left = os.replace, [write]

        def dying(*paths):
            left[0] -= 1
            if left[0] == 0 and before:
                os._exit(9)
            replace(*paths)
            if left[0] == 0:
                os._exit(9)

        os.replace = dying
        try:
            training()
        except BaseException:
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 9)
    return code == 9
