use super::step::Step;
use super::tensor::Tensor;
use super::zoom::Gazes;
use super::{Device, GpuError, NetworkPlan};
use crate::camera::Intrinsics;
use crate::network::{Network, Overlay, Zoom};

/// What turns a mask network's camera to the robot: a coarse network's mask of the canonical image. Beyond what that camera
/// sees, the coarse mask stays.
#[derive(Debug)]
pub(super) struct Coarse {
    network: NetworkPlan,
    gazes: Gazes,
    /// From the coarse mask to the cameras.
    look: Step,
}

impl Coarse {
    /// From `image` by `network` to where the mask network looks, each pixel of the coarse mask as heavy as it is probable: a
    /// share of it that rose steeply would turn the camera by roundings. `planned` is told of each layer. Driver errors reach the
    /// caller's [`Device::scoped`].
    ///
    /// # Errors
    /// Images too large or too many for the adapter's limits.
    pub fn new(
        device: &Device,
        (network, zoom): (&Network, Zoom),
        image: &Tensor,
        canonical: Intrinsics,
        planned: &mut dyn FnMut(),
    ) -> Result<Self, GpuError> {
        let network = NetworkPlan::planned(device, "coarse", network, image, None, planned)?;
        let gazes = Gazes::new(device, canonical, image.batch)?;
        let look = gazes.zoom(device, network.output(), zoom, Overlay::Multiply {})?;
        let look = look.labelled("coarse.zoom".to_owned());
        Ok(Self {
            network,
            gazes,
            look,
        })
    }

    /// The dispatches from the canonical cameras' images to where the mask network looks, in order.
    pub fn steps(&self) -> impl Iterator<Item = &Step> {
        self.network.steps().iter().chain([&self.look])
    }

    /// Where it looks.
    pub fn gazes(&self) -> &Gazes {
        &self.gazes
    }

    /// The canonical camera's mask, and the dispatch that makes it of what the mask network says is `closer`.
    ///
    /// # Errors
    /// As [`Coarse::new`].
    pub fn merge(&self, device: &Device, closer: &Tensor) -> Result<Merged, GpuError> {
        let coarse = self.network.output();
        let mask = Tensor::in_layout(
            device,
            closer.layout(),
            "mask",
            closer.shape,
            closer.batch,
            0,
        )?;
        let step = self.gazes.zoom_mask(device, closer, coarse, &mask)?;
        Ok(Merged { step, mask })
    }
}

/// A mask of two, and the dispatch that makes it.
#[derive(Debug)]
pub(super) struct Merged {
    pub step: Step,
    pub mask: Tensor,
}
