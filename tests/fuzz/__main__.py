"""Fuzz the readers of files, as long as you like.

    python -m tests.fuzz                        1,000 inputs for each reader
    python -m tests.fuzz native spudd --inputs 1000000 --state fuzz.json
    python -m tests.fuzz --state fuzz.json --report
    python -m tests.fuzz native --input 4711    one input, and what is done with it

The state file is written after each block of 1,000 inputs: end the command at any time, and give the same
state file to go on.  What breaks a rule is kept beside it, in the folder STATE.findings.  With
FACTORED_POLCA_DATA set, the model files in that folder are among those that inputs are made of.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from .campaign import Campaign, guarded, input_of, run, summary, verdict
from .readers import READERS, prepared
from .work import watched


def main() -> int:
    """Run the command; status 1 if there are findings."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(READERS)}; none: all")
    parser.add_argument("--inputs", type=int, default=1000, help="inputs for each reader, in all")
    parser.add_argument("--state", type=Path, help="the file that keeps the state")
    parser.add_argument("--seed", type=int, default=0, help="which inputs")
    parser.add_argument("--report", action="store_true", help="print the state and end")
    parser.add_argument("--input", type=int, help="judge one input, by its number")
    given = parser.parse_args()
    names = given.readers or list(READERS)
    if unknown := [name for name in names if name not in READERS]:
        parser.error(f"no reader {unknown[0]!r}; there are {', '.join(READERS)}")
    if given.input is not None:
        for name in names:
            data = input_of(given.seed, name, given.input)
            sys.stdout.buffer.write(data + b"\n")
            sys.stdout.flush()
            with guarded(), watched(), prepared():
                print(f"-- {name}:", verdict(READERS[name], data, 0))
        return 0
    path = given.state or Path(tempfile.mkdtemp()) / "fuzz.json"
    campaign = Campaign.opened(path, given.seed)
    if not given.report:
        try:
            run(campaign, names, given.inputs, lambda text: print(text, flush=True))
        except KeyboardInterrupt:
            campaign = Campaign.opened(path, given.seed)
    print(summary(campaign, names))
    found = 0
    for name in names:
        for sign, finding in campaign.of(name)["findings"].items():
            found += finding["count"]
            kept = path.with_suffix(".findings")
            print(f"{name}: {finding['count']} x {sign}; inputs {finding['inputs']} in {kept}")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
