"""`python -m swarmtwin`: the same as `swarmtwin`."""

from swarmtwin.commands import main

main()
