"""Entry point of `python -m trilat_net`, the same as `trilat`."""

from .cli import main

if __name__ == "__main__":
    main()
