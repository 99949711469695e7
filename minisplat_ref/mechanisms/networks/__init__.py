"""Small networks with gradients written by hand: :mod:`.mlp`, fully connected layers with ReLU between them."""
