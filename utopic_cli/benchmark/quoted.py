"""The paper's own figures (UTOPIC: Tab. 1, Tab. 4, Tab. 5), to be printed beside ours and marked as quoted.

They are on ModelNet40 and ScanObjectNN with shared points and the paper's rotations: other shapes than
most of our runs. Compare ratios to the statistical floor, not digits.
"""

from __future__ import annotations

METRICS = ("rmse_r", "mae_r", "rmse_t", "mae_t", "error_r", "error_t")

QUOTED: dict[str, dict[str, tuple[float, float, float, float, float, float]]] = {
    "modelnet": {
        "IDAM": (10.8991, 7.4032, 0.14258, 0.09009, 14.2849, 0.19260),
        "RPM-Net": (2.5491, 0.8849, 0.01984, 0.00865, 1.6914, 0.01830),
        "OMNet": (8.2406, 5.8538, 0.09341, 0.06161, 11.4084, 0.12982),
        "RGM": (3.0068, 0.8072, 0.02556, 0.00699, 1.5610, 0.01458),
        "Predator": (0.6505, 0.4609, 0.01148, 0.00447, 0.8643, 0.00904),
        "REGTR": (1.1690, 0.1894, 0.00434, 0.00153, 0.3493, 0.00306),
        "UTOPIC": (0.2238, 0.1322, 0.00212, 0.00131, 0.2464, 0.00264),
    },
    "modelonet": {
        "IDAM": (16.9098, 11.7129, 0.23770, 0.15980, 22.6078, 0.34240),
        "RPM-Net": (6.6189, 2.0453, 0.04813, 0.01827, 3.8514, 0.03835),
        "OMNet": (10.2776, 7.7237, 0.12428, 0.08294, 15.0794, 0.17329),
        "RGM": (17.8005, 5.5261, 0.10970, 0.04025, 9.8361, 0.08408),
        "Predator": (16.0141, 3.3206, 0.12510, 0.03281, 5.8900, 0.07673),
        "REGTR": (3.4594, 1.3427, 0.03216, 0.01254, 2.5753, 0.02617),
        "UTOPIC": (2.5463, 0.8588, 0.02098, 0.00765, 1.5934, 0.01555),
    },
    "scanobjectnn": {
        "IDAM": (15.9602, 8.0429, 0.13187, 0.07255, 15.2581, 0.15084),
        "RPM-Net": (8.1251, 2.8829, 0.08984, 0.03314, 5.4576, 0.07384),
        "OMNet": (10.5122, 7.9538, 0.11367, 0.07984, 15.2959, 0.16384),
        "RGM": (12.6069, 3.7596, 0.08729, 0.02740, 7.0376, 0.05634),
        "Predator": (12.6050, 4.8842, 0.12480, 0.04899, 9.4936, 0.10070),
        "REGTR": (2.1477, 0.7448, 0.02268, 0.00614, 1.3842, 0.01247),
        "UTOPIC": (3.6790, 0.2633, 0.01394, 0.00179, 0.5601, 0.00366),
    },
}

DATA = {"modelnet": "modelnet40:", "modelonet": "modelnet40:", "scanobjectnn": "scanobjectnn:"}
"""What the name of the data begins with where it is the data set the figures are on."""

OVERLAP_ACCURACY = {"modelnet": {"UTOPIC": 0.9646, "UTOPIC, no uncertainty": 0.9119}}
"""Share of the points whose overlap is told right."""

SECONDS = {
    "IDAM": {717: 0.07, 512: 0.07},
    "RPM-Net": {717: 0.16, 512: 0.13},
    "OMNet": {717: 0.03, 512: 0.03},
    "RGM": {717: 0.17, 512: 0.14},
    "Predator": {717: 0.29, 512: 0.23},
    "REGTR": {717: 0.05, 512: 0.05},
    "UTOPIC": {717: 0.06, 512: 0.06},
}
"""Seconds for one pair by number of points."""

TIMED_ON = "RTX 2080 Ti"
