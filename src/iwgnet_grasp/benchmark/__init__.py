"""Figures of the whole project, each beside its goal and, with --peers, beside a peer's."""
