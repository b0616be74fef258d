//! Pictures for people: masks, tinted overlays, joints drawn along the arm.
