"""For processes under libfaketime: its version 0.9.10 refuses the absolute times that Python's sleep waits
for (clock_nanosleep answers EINVAL), so they sleep by select instead.
"""

import select
import time


def _sleep(seconds: float) -> None:
    select.select([], [], [], seconds)


time.sleep = _sleep
