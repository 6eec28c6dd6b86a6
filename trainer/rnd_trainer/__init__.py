"""Learns an avatar from a monocular capture: the paper's networks, losses and two training stages, in torch."""
