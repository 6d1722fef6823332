"""A detector for `sliplab bench` as a program of its own: `sliplab bench "run:python rate.py"`.

It needs nothing of SlipLab. Evidence is the number of events of each 10 ms.
"""

import struct
import sys

HEAD, EVENT, ANSWER = struct.Struct("<4sIq"), struct.Struct("<qHHB3x"), struct.Struct("<qdi4x")
STEP_US = 10_000


def main() -> None:
    """Answer messages until standard input is closed."""
    read, write = sys.stdin.buffer.read, sys.stdout.buffer.write
    end_us, count = STEP_US, 0
    while head := read(HEAD.size):
        kind, n, value = HEAD.unpack(head)
        if kind == b"SCEN":
            end_us, count = STEP_US, 0
            continue
        answers = []
        for t_us, _x, _y, _p in EVENT.iter_unpack(read(n * EVENT.size)):
            while t_us >= end_us:
                answers.append(ANSWER.pack(end_us, count, -1))
                end_us, count = end_us + STEP_US, 0
            count += 1
        while value >= end_us:
            answers.append(ANSWER.pack(end_us, count, -1))
            end_us, count = end_us + STEP_US, 0
        write(HEAD.pack(b"EVID", len(answers), 0) + b"".join(answers))
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
