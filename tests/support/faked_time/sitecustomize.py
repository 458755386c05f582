"""The clock of a process under test, hours ahead of the machine's as the file says that the tests write.

Under libfaketime only sleeping is mended: its version 0.9.10 refuses the absolute times that Python's sleep
waits for (clock_nanosleep answers EINVAL). Without it the clocks that Python code reads are replaced here,
and the one that SQLite's statements read.
"""

import ctypes
import datetime
import functools
import gc
import os
import select
import sqlite3
import time
from pathlib import Path
from typing import Any

_FILE = Path(os.environ["FAKETIME_TIMESTAMP_FILE"])
_time, _now = time.time, datetime.datetime.now
_connect = sqlite3.connect


def _ahead() -> float:
    return float(_FILE.read_text())


def _sleep(seconds: float) -> None:
    select.select([], [], [], seconds)


def _faked_now(_: type, zone: Any = None) -> datetime.datetime:
    return _now(zone) + datetime.timedelta(seconds=_ahead())


def _faked_julianday(when: str) -> float:
    assert when == "now"
    return (_time() + _ahead()) / 86_400.0 + 2_440_587.5


def _faked_strftime(form: str, when: str) -> str:
    assert (form, when) == ("%Y-%m-%d %H:%M:%f", "now")
    return _faked_now(datetime.datetime, datetime.UTC).strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]


@functools.wraps(_connect)
def _faked_connect(*arguments: Any, **options: Any) -> sqlite3.Connection:
    connection = _connect(*arguments, **options)
    connection.create_function("julianday", 1, _faked_julianday)
    connection.create_function("strftime", 2, _faked_strftime)
    return connection


if "libfaketime" in os.environ.get("LD_PRELOAD", ""):
    time.sleep = _sleep
else:
    time.time = lambda: _time() + _ahead()
    time.time_ns = lambda: int(time.time() * 1e9)
    # The class itself has to stay the one that everybody compares with.
    gc.get_referents(datetime.datetime.__dict__)[0]["now"] = classmethod(_faked_now)
    ctypes.pythonapi.PyType_Modified(ctypes.py_object(datetime.datetime))
    sqlite3.connect = sqlite3.dbapi2.connect = _faked_connect
