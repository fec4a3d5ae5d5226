"""What a picture or a fit may leave out, decided from the scene beforehand, with a bound on the error of each."""
