use super::step::Step;
use super::tensor::Tensor;
use super::zoom::Gazes;
use super::{Device, GpuError, NetworkPlan};
use crate::camera::Intrinsics;
use crate::network::{Overlay, Zoom};

/// A mask network's two looks: at the canonical image, and at what a camera sees of it that is turned to the first look's mask.
/// The network is planned once, and run on one tensor twice.
#[derive(Debug)]
pub(super) struct SecondLook {
    /// The image to the network's input.
    before: Step,
    /// From the network's first output to the mask.
    after: Vec<Step>,
    mask: Tensor,
}

impl SecondLook {
    /// Of `network`, which reads `input`, at `image` of the same shape, turned by `zoom` to its mask, each pixel as heavy as it
    /// is probable: a share of it that rose steeply would turn the camera by roundings. Driver errors reach the caller's [`Device::scoped`].
    ///
    /// # Errors
    /// Images too large or too many for the adapter's limits.
    pub fn new(
        device: &Device,
        network: &NetworkPlan,
        (image, input): (&Tensor, &Tensor),
        canonical: Intrinsics,
        zoom: Zoom,
    ) -> Result<Self, GpuError> {
        let found = network.output();
        let plane = |what| {
            let margin = 0;
            Tensor::in_layout(
                device,
                found.layout(),
                what,
                found.shape,
                found.batch,
                margin,
            )
        };
        let (first, mask) = (plane("first mask")?, plane("mask")?);
        let straight = Gazes::canonical(device, canonical, image.batch)?;
        let gazes = Gazes::new(device, canonical, image.batch)?;
        let mut after = vec![
            straight
                .zoom_image(device, found, &first)?
                .labelled("first.zoom_image"),
            gazes
                .zoom(device, &first, zoom, Overlay::Multiply {})?
                .labelled("second.zoom"),
            gazes
                .zoom_image(device, image, input)?
                .labelled("second.zoom_image"),
        ];
        after.extend(network.steps().iter().map(|step| {
            let layer = step.label().split_once('.').map_or("", |(_, layer)| layer);
            step.labelled(&format!("second.{layer}"))
        }));
        let merged = gazes.zoom_mask(device, found, &first, &mask)?;
        after.push(merged.labelled("second.zoom_mask"));
        let before = straight.zoom_image(device, image, input)?;
        Ok(Self {
            before: before.labelled("zoom_image"),
            after,
            mask,
        })
    }

    /// The dispatch in front of the network's.
    pub fn before(&self) -> &Step {
        &self.before
    }

    /// The dispatches behind the network's, in order: its second ones are among them.
    pub fn after(&self) -> &[Step] {
        &self.after
    }

    /// The mask of both.
    pub fn mask(&self) -> &Tensor {
        &self.mask
    }
}
