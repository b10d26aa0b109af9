//! The page's file: `viewer/page.html` with the style sheet, the programs and the data in it.

use std::io::Write as _;

use serde::Serialize;

use crate::Error;
use crate::output_file::OutputFile;

const TEMPLATE: &str = include_str!("viewer/page.html");
const STYLE: &str = include_str!("viewer/page.css");
const VIEWER: &str = include_str!("viewer/page.js");
const THREE: &str = include_str!("../../data/three/three.js");
/// Every copy of three.js must have its licence.
const LICENCE: &str = include_str!("../../data/three/LICENSE");

/// What a page shows.
#[derive(Clone, Debug, Serialize)]
pub struct Document {
    /// The page's title.
    pub title: String,
    /// Seconds of a control step.
    pub step: f64,
    /// The names of the reward's terms.
    pub terms: Vec<String>,
    /// Where the reference is at first: `off`, `on` (at its own position) or `beside` (a metre to the right in the picture).
    pub ghost: &'static str,
    /// The scenes, which the episodes name.
    pub scenes: Vec<Scene>,
    /// The episodes, in the order of the list.
    pub episodes: Vec<Episode>,
}

/// The shapes of a model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scene {
    /// The shapes.
    pub shapes: Vec<Shape>,
}

/// A rigid shape; see [`comic_tasks::geometry::Shape`].
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Shape {
    /// `plane`, `sphere`, `capsule`, `ellipsoid`, `cylinder` or `box`.
    pub form: &'static str,
    /// MuJoCo's sizes of the form, m.
    pub size: [f32; 3],
    /// Red, green, blue and opacity, 0 to 1.
    pub colour: [f32; 4],
    /// Its body's place among the poses; `null` for the world.
    pub body: Option<usize>,
    /// x, y and z in the frame of the body, m.
    pub position: [f32; 3],
    /// Unit quaternion w, x, y, z in the frame of the body.
    pub rotation: [f32; 4],
}

/// An episode.
#[derive(Clone, Debug, Serialize)]
pub struct Episode {
    /// Its name in the list.
    pub name: String,
    /// What else is said of it.
    pub note: String,
    /// Its scene.
    pub scene: usize,
    /// Its control steps.
    pub steps: usize,
    /// Control steps from one pose to the next; the last pose is that of the last step.
    pub every: usize,
    /// The poses of the bodies.
    pub poses: Poses,
    /// The poses of the reference's bodies, which are the first of the bodies; `null` in a task without a reference.
    pub reference: Option<Poses>,
    /// The target's place on the floor at each pose, x and y, m; empty without a target.
    pub targets: Vec<[f32; 2]>,
    /// The reward's terms of each step, a list for each term.
    pub rewards: Vec<Vec<f32>>,
}

/// Poses in 14 bytes each, as base64: x, y and z (little-endian u16, from `low` to `high`), and a unit quaternion w, x, y, z
/// (little-endian i16, in 1/32767).
#[derive(Clone, Debug, Serialize)]
pub struct Poses {
    /// Bodies of a frame.
    pub bodies: usize,
    /// The lowest x, y and z of all, m.
    pub low: [f64; 3],
    /// The highest x, y and z of all, m.
    pub high: [f64; 3],
    /// The poses, frame by frame.
    pub data: String,
}

impl Document {
    /// Writes the page.
    ///
    /// # Errors
    /// [`Error::File`] when it cannot be written.
    pub(crate) fn write(&self, file: OutputFile) -> Result<(), Error> {
        let html = self.html()?;
        let out = file.out().to_path_buf();
        file.file().write_all(html.as_bytes()).map_err(Error::file(&out))?;
        file.finish().map_err(Error::file(&out))?;
        tracing::info!(file = %out.display(), episodes = self.episodes.len(), bytes = html.len(), "page written");
        Ok(())
    }

    /// The page's text.
    fn html(&self) -> Result<String, Error> {
        let data = serde_json::to_string(self)
            .map_err(|error| Error::Usage(format!("cannot write the page's data as JSON: {error}")))?;
        // Within a script element only `<` can end the element. In JSON it stands only in strings.
        let data = data.replace('<', "\\u003c");
        let parts = [("STYLE", STYLE), ("LICENCE", LICENCE), ("THREE", THREE), ("DATA", &data), ("VIEWER", VIEWER)];
        let mut html = String::with_capacity(TEMPLATE.len() + parts.iter().map(|(_, text)| text.len()).sum::<usize>());
        let mut rest = TEMPLATE;
        for (name, text) in parts {
            let mark = format!("/*{name}*/");
            let (before, after) = rest.split_once(&mark).unwrap_or((rest, ""));
            html.push_str(before);
            html.push_str(text);
            rest = after;
        }
        html.push_str(rest);
        Ok(html)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_of_a_clip_ends_the_data() {
        let hostile = "</script><script>alert(1)</script><!-- /*VIEWER*/";
        let document = Document {
            title: hostile.into(),
            step: 0.03,
            terms: vec![hostile.into()],
            ghost: "off",
            scenes: Vec::new(),
            episodes: Vec::new(),
        };
        let html = document.html().unwrap();
        let ends = |text: &str| text.matches("</script").count();
        assert_eq!(ends(&html), ends(TEMPLATE));
        let (_, data) = html.split_once("id=\"data\">").unwrap();
        let (data, _) = data.split_once("</script>").unwrap();
        let read: serde_json::Value = serde_json::from_str(data).unwrap();
        assert_eq!(read, serde_json::to_value(&document).unwrap());
    }

    #[test]
    fn everything_is_in_the_page() {
        let document = Document {
            title: "a walk".into(),
            step: 0.03,
            terms: Vec::new(),
            ghost: "on",
            scenes: Vec::new(),
            episodes: Vec::new(),
        };
        let html = document.html().unwrap();
        for part in [STYLE, LICENCE, THREE, VIEWER, r#""title":"a walk""#] {
            assert_eq!(html.matches(part).count(), 1);
        }
        for outside in ["src=", "href=", "@import", "fetch(", "import("] {
            assert!(![TEMPLATE, STYLE, VIEWER].iter().any(|part| part.contains(outside)), "{outside}");
        }
    }
}
