"""Fair comparison: every law tuned by one written procedure, shown as a front of error against effort.

Law: what one law is given every law is given: the number of candidates, the clamp of the torque, the horizon,
the seeds, what it is told of gravity, and how it is judged. Nothing is ranked by e alone: arms that hang
together have e = 0.

The procedure, the formulas and the search table stand in docs/fair-comparison.md.

    from trilat_net.tuning import plan

    if __name__ == "__main__":  # the candidates run in processes of their own
        found = plan("free", budget=16).run()
"""

from .tuning import Plan, Tuned, plan

__all__ = ["Plan", "Tuned", "plan"]
