"""Depth Anything 3: a network that predicts cameras and depths of all photos in one pass.

H. Lin, S. Chen, J. H. Liew, D. Y. Chen et al.: "Depth Anything 3: Recovering the Visual Space from
Any Views", arXiv 2511.10647, 2025. This implementation follows the paper and the layout of the
published checkpoints. It has the sizes SMALL and BASE, whose weights are published under
Apache-2.0; they are not part of igsr.
"""
