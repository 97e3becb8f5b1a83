"""Per-call work, torch only: the energy, the solver and the layers."""
