"""Exit codes of the program.

`flows.cli.errors` chooses the code of an error; a command that finds something wrong, such as
`sliplab verify`, ends with `FAILED` itself. A command line that cannot be read is `WRONG_INPUT`.
"""

from __future__ import annotations

DONE = 0
"""Everything was done."""
FAILED = 1
"""The work failed, or what was checked is not in order."""
WRONG_INPUT = 2
"""A file, an option or a value is wrong; nothing was done."""
UNREAD = 141
"""The reader of the result has ended, as `head` does: 128 and the number of SIGPIPE."""
INTERRUPTED = 130
"""The user stopped the program: 128 and the number of SIGINT, as shells have it."""
