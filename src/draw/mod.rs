//! Pictures for people: masks, tinted overlays, joints drawn along the arm, charts and sheets of pictures.

#[cfg(feature = "cli")]
mod annotated;
#[cfg(feature = "cli")]
mod chart;
mod colours;
mod mask;
#[cfg(feature = "cli")]
mod sheet;

#[cfg(feature = "cli")]
pub use annotated::annotated;
#[cfg(feature = "cli")]
pub use chart::{
    BarChart, BarGroup, ChartError, Line, LineChart, Row, RowChart, bar_charts, line_charts,
    row_chart,
};
pub use colours::JOINT_COLOURS;
pub use mask::mask_image;
#[cfg(feature = "cli")]
pub use sheet::{SheetRow, sheet};
