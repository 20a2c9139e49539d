"""`python -m trilat_net` is `trilat`."""

from .cli import main

if __name__ == "__main__":
    main()
