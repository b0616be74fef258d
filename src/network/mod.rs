//! What a network is: layers, shapes, the model file. No GPU here.
