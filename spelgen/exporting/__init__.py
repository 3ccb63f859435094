"""Export of a trained model to the file formats of other tools."""
