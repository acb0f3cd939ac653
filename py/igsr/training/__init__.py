"""What the trainings of networks share: the run with its log and checkpoints, steps, the plot.

Nothing here knows what is trained; ``igsr.denoiser.training`` and ``igsr.pose.da3.training`` do.
"""
