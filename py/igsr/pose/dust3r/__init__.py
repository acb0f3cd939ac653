"""DUSt3R: a network that predicts the points that two photos see, in the frame of the first.

S. Wang, V. Leroy, Y. Cabon, B. Chidlovskii, J. Revaud: "DUSt3R: Geometric 3D Vision Made Easy",
CVPR 2024. The network is written anew from the paper and the layout of its checkpoints; the weights
are under a non-commercial licence and are never part of igsr.
"""
