"""From a data set to a checkpoint: batches, losses, optimiser, trainer."""
