"""The paper's choices and this project's, each undone alone, all else equal.

A variant composes the package's own parts in another way: other features, another target,
another network or another way to train. None of it is a flag of the package.
"""
