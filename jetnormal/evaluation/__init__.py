"""The PCPNet protocol over any estimator: errors of normals per cloud, category and model, as tables and pictures.

The error of a cloud is taken over the points that its .pidx file names, that of a category is the mean over its
clouds, and the average is the mean over the categories (Guerrero et al., "PCPNet: Learning Local Shape Properties
from Raw Point Clouds", Eurographics 2018).
"""

from jetnormal.evaluation.protocol import CloudResult, Evaluation, ModelResult, evaluate
from jetnormal.evaluation.scores import Scores

__all__ = ["CloudResult", "Evaluation", "ModelResult", "Scores", "evaluate"]
