"""DUSt3R: a network that predicts the points of two photos in the camera frame of the first.

S. Wang, V. Leroy, Y. Cabon, B. Chidlovskii, J. Revaud: "DUSt3R: Geometric 3D Vision Made Easy",
CVPR 2024. This implementation follows the paper and the layout of the published checkpoints. Their
weights are under a non-commercial license and are not part of igsr.
"""
