"""Training of the denoiser: pairs of renders and photos, losses, and the training itself.

``pairs.make_pairs`` renders views of degraded fits; ``train_network.train`` trains a network on
such pairs with the settings of ``training_settings.Training``.
"""
