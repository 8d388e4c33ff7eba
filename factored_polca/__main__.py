"""`python -m factored_polca` is the command `factored-polca`."""

from factored_polca.cli import main

raise SystemExit(main())
