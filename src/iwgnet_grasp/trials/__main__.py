"""`python -m iwgnet_grasp.trials`: see command.py. Ctrl-C ends its imports in one line, too."""

import sys

try:
    from iwgnet_grasp.trials.command import main
except KeyboardInterrupt:
    sys.exit("run_trials: interrupted")

main()
