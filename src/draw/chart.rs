use image::RgbImage;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use plotters::style::{FontStyle, register_font};

/// A chart that could not be drawn.
#[derive(Debug, thiserror::Error)]
#[error("chart: {0}")]
pub struct ChartError(String);

/// A quantity over another, side by side with others.
#[derive(Debug, Clone, PartialEq)]
pub struct LineChart {
    /// What is shown, with its unit.
    pub title: String,
    /// What lies along x, with its unit.
    pub x: String,
    /// The curves.
    pub lines: Vec<Line>,
}

/// A curve, in a colour of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// What the legend says.
    pub name: String,
    /// `[x, y]`, in the order of x, all finite.
    pub points: Vec<[f64; 2]>,
}

/// Medians as bars and 95th percentiles as whiskers, in groups.
#[derive(Debug, Clone, PartialEq)]
pub struct BarChart {
    /// What is shown, with its unit.
    pub title: String,
    /// What the bars of a group are, in their order.
    pub legend: Vec<String>,
    /// The groups from left to right.
    pub groups: Vec<BarGroup>,
}

/// Bars that stand together.
#[derive(Debug, Clone, PartialEq)]
pub struct BarGroup {
    /// What stands below.
    pub name: String,
    /// `[median, 95th percentile]` of each bar, finite and not negative.
    pub bars: Vec<[f64; 2]>,
}

/// A bar a row, coloured by kind: the kinds that make up most have colours of their own.
#[derive(Debug, Clone, PartialEq)]
pub struct RowChart {
    /// What is shown, with its unit.
    pub title: String,
    /// The rows from top to bottom.
    pub rows: Vec<Row>,
}

/// A row of a [`RowChart`].
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// What stands before the bar.
    pub name: String,
    /// What its colour means.
    pub kind: String,
    /// Its length, finite and not negative.
    pub value: f64,
    /// What stands behind the bar.
    pub note: String,
}

const PANEL: (u32, u32) = (560, 400);
const FONT: &str = "sans-serif";
const TEXT: f64 = 15.0;
const INK: RGBColor = RGBColor(40, 40, 46);
const GREY: RGBColor = RGBColor(150, 150, 156);
const PALE: RGBColor = RGBColor(225, 225, 230);
/// Told apart by those who see no red or green (Okabe and Ito).
const COLOURS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
];

type Panel<'a> = DrawingArea<BitMapBackend<'a>, Shift>;

/// Charts side by side.
///
/// # Errors
/// The drawing library's.
pub fn line_charts(charts: &[LineChart]) -> Result<RgbImage, ChartError> {
    side_by_side(charts, line_chart)
}

/// Charts side by side, of one height.
///
/// # Errors
/// The drawing library's.
pub fn bar_charts(charts: &[BarChart]) -> Result<RgbImage, ChartError> {
    side_by_side(charts, bar_chart)
}

/// A chart as high as its rows need, the legend below.
///
/// # Errors
/// The drawing library's.
pub fn row_chart(chart: &RowChart) -> Result<RgbImage, ChartError> {
    const LINE: i32 = 22;
    const WIDTH: i32 = 900;
    const NAMES: i32 = 148;
    const NOTES: i32 = 260;
    const OTHERS: &str = "others";
    let mut totals: Vec<(&str, f64)> = Vec::new();
    for row in &chart.rows {
        match totals.iter_mut().find(|(kind, _)| *kind == row.kind) {
            Some((_, total)) => *total += row.value,
            None => totals.push((&row.kind, row.value)),
        }
    }
    totals.sort_by(|(_, a), (_, b)| b.total_cmp(a));
    let mut kinds: Vec<&str> = totals.iter().map(|(kind, _)| *kind).collect();
    if kinds.len() > COLOURS.len() {
        kinds.truncate(COLOURS.len());
        kinds.push(OTHERS);
    }
    let colour_of = |kind: &str| {
        let place = kinds.iter().position(|k| *k == kind);
        place.and_then(|p| COLOURS.get(p)).copied().unwrap_or(GREY)
    };
    let top = chart.rows.iter().map(|row| row.value).fold(1e-9, f64::max);
    let lines = chart.rows.len() as i32 + kinds.len().div_ceil(3) as i32 + 3;
    let mut image = RgbImage::new(WIDTH as u32, (lines * LINE) as u32);
    on_canvas(&mut image, |canvas| {
        canvas.fill(&WHITE).map_err(failed)?;
        let text = |text: &str, x: i32, y: i32, size: f64| {
            let style = (FONT, size).into_font().color(&INK);
            canvas.draw_text(text, &style, (x, y)).map_err(failed)
        };
        let bar = |kind: &str, x: i32, y: i32, width: i32| {
            let corners = [(x, y + 2), (x + width.max(1), y + LINE - 4)];
            let bar = Rectangle::new(corners, colour_of(kind).filled());
            canvas.draw(&bar).map_err(failed)
        };
        text(&chart.title, 12, 8, 1.2 * TEXT)?;
        let mut y = 2 * LINE - LINE / 2;
        for row in &chart.rows {
            let length = f64::from(WIDTH - NAMES - NOTES) * row.value / top;
            text(&row.name, 12, y + 5, TEXT)?;
            bar(&row.kind, NAMES, y, length as i32)?;
            text(&row.note, NAMES + length as i32 + 8, y + 5, TEXT)?;
            y += LINE;
        }
        y += LINE / 2;
        for (number, kind) in (0..).zip(&kinds) {
            let (x, y) = (12 + number % 3 * 290, y + number / 3 * LINE);
            bar(kind, x, y, LINE - 6)?;
            text(kind, x + LINE, y + 5, TEXT)?;
        }
        Ok(())
    })?;
    Ok(image)
}

fn side_by_side<T>(
    charts: &[T],
    draw: impl Fn(&T, &Panel<'_>) -> Result<(), ChartError>,
) -> Result<RgbImage, ChartError> {
    let mut image = RgbImage::new(PANEL.0 * charts.len() as u32, PANEL.1);
    on_canvas(&mut image, |canvas| {
        canvas.fill(&WHITE).map_err(failed)?;
        let panels = canvas.split_evenly((1, charts.len()));
        charts
            .iter()
            .zip(&panels)
            .try_for_each(|(chart, panel)| draw(chart, panel))
    })?;
    Ok(image)
}

/// Text in lines of `size` pixels: `(text, [x, y] of its top left corner)`.
pub(super) fn write(
    image: &mut RgbImage,
    size: f64,
    texts: &[(String, [u32; 2])],
) -> Result<(), ChartError> {
    on_canvas(image, |canvas| {
        let style = (FONT, size).into_font().color(&INK);
        texts.iter().try_for_each(|(text, [x, y])| {
            let at = (*x as i32, *y as i32);
            canvas.draw_text(text, &style, at).map_err(failed)
        })
    })
}

fn on_canvas(
    image: &mut RgbImage,
    draw: impl FnOnce(&Panel<'_>) -> Result<(), ChartError>,
) -> Result<(), ChartError> {
    // Machines without a screen have no fonts: this one is in the program.
    register_font(FONT, FontStyle::Normal, dejavu::sans::regular())
        .map_err(|_| ChartError("the font cannot be read".into()))?;
    let size = image.dimensions();
    let canvas = BitMapBackend::with_buffer(image, size).into_drawing_area();
    draw(&canvas)?;
    canvas.present().map_err(failed)
}

fn failed(error: impl std::fmt::Display) -> ChartError {
    ChartError(error.to_string())
}

/// A number on an axis, without the digits that rounding leaves.
fn label(value: &f64) -> String {
    ((value * 1e6).round() / 1e6).to_string()
}

fn line_chart(chart: &LineChart, panel: &Panel<'_>) -> Result<(), ChartError> {
    let points = || chart.lines.iter().flat_map(|line| &line.points);
    let range = |axis: usize| {
        let low = points().map(|p| p[axis]).fold(f64::INFINITY, f64::min);
        let high = points().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max);
        let margin = (0.05 * (high - low)).max(1e-3 * high.abs()).max(1e-9);
        (low - margin)..(high + margin)
    };
    let mut builder = ChartBuilder::on(panel);
    let mut context = builder
        .caption(&chart.title, (FONT, 1.2 * TEXT).into_font().color(&INK))
        .margin(12)
        .x_label_area_size(44)
        .y_label_area_size(56)
        .build_cartesian_2d(range(0), range(1))
        .map_err(failed)?;
    context
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(PALE)
        .axis_style(INK)
        .x_labels(5)
        .x_label_formatter(&label)
        .y_label_formatter(&label)
        .x_desc(&chart.x)
        .label_style((FONT, TEXT).into_font().color(&INK))
        .draw()
        .map_err(failed)?;
    for (line, colour) in chart.lines.iter().zip(COLOURS.into_iter().cycle()) {
        let points = line.points.iter().map(|&[x, y]| (x, y));
        context
            .draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)))
            .map_err(failed)?
            .label(&line.name)
            .legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 12, y + 5)], colour.filled()));
        context
            .draw_series(points.map(|point| Circle::new(point, 3, colour.filled())))
            .map_err(failed)?;
    }
    context
        .configure_series_labels()
        .position(SeriesLabelPosition::MiddleRight)
        .background_style(WHITE.mix(0.8))
        .label_font((FONT, TEXT).into_font().color(&INK))
        .draw()
        .map_err(failed)
}

fn bar_chart(chart: &BarChart, panel: &Panel<'_>) -> Result<(), ChartError> {
    let tops = chart.groups.iter().flat_map(|group| &group.bars);
    let top = tops.flatten().copied().fold(1e-9, f64::max);
    let mut builder = ChartBuilder::on(panel);
    let mut context = builder
        .caption(&chart.title, (FONT, 1.2 * TEXT).into_font().color(&INK))
        .margin(12)
        .x_label_area_size(32)
        .y_label_area_size(48)
        // Room for the legend.
        .build_cartesian_2d(0.0..chart.groups.len() as f64, 0.0..1.3 * top)
        .map_err(failed)?;
    context
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(PALE)
        .axis_style(INK)
        .x_labels(0)
        .y_label_formatter(&label)
        .label_style((FONT, TEXT).into_font().color(&INK))
        .draw()
        .map_err(failed)?;
    let below = Pos::new(HPos::Center, VPos::Top);
    let style = (FONT, 0.85 * TEXT).into_font().color(&INK).pos(below);
    for (place, group) in chart.groups.iter().enumerate() {
        let (x, y) = context.backend_coord(&(place as f64 + 0.5, 0.0));
        // The panel's own coordinates begin at its corner.
        let (left, above) = panel.get_base_pixel();
        panel
            .draw_text(&group.name, &style, (x - left, y - above + 8))
            .map_err(failed)?;
    }
    for (index, name) in chart.legend.iter().enumerate() {
        let colour = COLOURS[index % COLOURS.len()];
        let width = 0.8 / chart.legend.len() as f64;
        let bars = chart
            .groups
            .iter()
            .enumerate()
            .filter_map(|(place, group)| {
                let left = place as f64 + 0.1 + width * index as f64;
                Some((left, *group.bars.get(index)?))
            });
        context
            .draw_series(bars.clone().map(|(left, [median, _])| {
                let right = left + 0.92 * width;
                Rectangle::new([(left, 0.0), (right, median)], colour.filled())
            }))
            .map_err(failed)?
            .label(name)
            .legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 12, y + 5)], colour.filled()));
        let whiskers = bars.flat_map(|(left, [median, high])| {
            let middle = left + 0.46 * width;
            let (from, to) = (middle - 0.2 * width, middle + 0.2 * width);
            [
                PathElement::new([(middle, median), (middle, high)], INK.stroke_width(1)),
                PathElement::new([(from, high), (to, high)], INK.stroke_width(1)),
            ]
        });
        context.draw_series(whiskers).map_err(failed)?;
    }
    context
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE.mix(0.8))
        .label_font((FONT, TEXT).into_font().color(&INK))
        .draw()
        .map_err(failed)
}
