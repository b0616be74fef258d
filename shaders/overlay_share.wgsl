// How much of the colour the overlay lets through where the mask has a probability: nothing up to LOW, all from HIGH on, in
// proportion between. For a threshold both are the same. Stands in front of the kernels that overlay.
override LOW: f32;
override HIGH: f32;

fn shown(probability: f32) -> f32 {
    if HIGH > LOW {
        return clamp((probability - LOW) / (HIGH - LOW), 0.0, 1.0);
    }
    return select(0.0, 1.0, probability >= LOW);
}
