"""The PCPNet protocol for any estimator: errors of normals by cloud, category and model, as tables and pictures.

The error of a cloud is that of the points which its .pidx file names. The error of a category is the mean over its
clouds, and the average is the mean over the categories (Guerrero et al., "PCPNet: Learning Local Shape Properties
from Raw Point Clouds", Eurographics 2018).
"""
