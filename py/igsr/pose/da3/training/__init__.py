"""How a network of Depth Anything 3's shape is trained, on captures of ``igsr synth``.

``training_settings`` says how, ``train_network`` does it: captures are made while they are needed
(``capture_source``), photos of one become a pass whose truth is known (``true_pass``), ``losses``
hold a prediction against it, ``learner`` learns, ``validation`` scores what was never trained on.
"""
