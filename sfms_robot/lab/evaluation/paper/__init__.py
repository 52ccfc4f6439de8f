"""Tables III and IV of the SFMS paper on any folder of faces: recipes, training, scores, rows."""
