"""The classifier two-sample test as the benchmark defines it (Lueckmann et al. 2021, appendix)."""

import numpy as np


def c2st(reference: np.ndarray, draws: np.ndarray, seed: int = 1) -> float:
    """Cross-validated accuracy of a classifier that tells two samples apart: 0.5 if it cannot, 1 if it always can.

    A multilayer perceptron of two layers of 10 D units, five folds, both samples scaled by the moments of the first.

    Args:
        reference: draws of the reference posterior, shape [N, D].
        draws: draws to compare, shape [N, D].
        seed: seed of the folds and of the classifier.

    Raises:
        ImportError: if scikit-learn is not installed: pip install 'jaxlfi[bench]'.
    """
    from sklearn.model_selection import KFold, cross_val_score
    from sklearn.neural_network import MLPClassifier

    mean, scale = reference.mean(axis=0), reference.std(axis=0, ddof=1)
    both = np.concatenate([(reference - mean) / scale, (draws - mean) / scale])
    label = np.repeat([0, 1], [len(reference), len(draws)])
    units = 10 * reference.shape[1]
    classifier = MLPClassifier((units, units), activation="relu", solver="adam", max_iter=10000, random_state=seed)
    folds = KFold(n_splits=5, shuffle=True, random_state=seed)
    return float(np.mean(cross_val_score(classifier, both, label, cv=folds, scoring="accuracy")))
