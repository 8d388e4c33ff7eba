"""Its presence puts this folder on the import path of every test, below it too: `import random_models`."""
