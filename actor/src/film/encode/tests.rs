use std::ffi::OsStr;
use std::path::PathBuf;

use super::*;

/// A picture of one colour, which depends on `frame`.
fn picture(size: Size, frame: u8) -> Vec<u8> {
    let colour = [20 * frame, 100, 255 - 20 * frame];
    colour.into_iter().cycle().take(size.bytes()).collect()
}

fn film(name: &str, frames: u8) -> (tempfile::TempDir, PathBuf, Size) {
    let directory = tempfile::tempdir().unwrap();
    let (out, size) = (directory.path().join(name), Size::new(34, 18).unwrap());
    let mut movie = Movie::create(&out, size, Duration::from_millis(30)).unwrap();
    for frame in 0..frames {
        movie.frame(&picture(size, frame)).unwrap();
    }
    assert!(!out.exists(), "the file is there before the film is finished");
    movie.finish().unwrap();
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 1, "something is left beside the film");
    (directory, out, size)
}

#[test]
fn a_gif_shows_every_frame_for_as_long_as_it_took() {
    let (_directory, out, size) = film("film.gif", 7);
    let mut options = ::gif::DecodeOptions::new();
    options.set_color_output(::gif::ColorOutput::RGBA);
    let mut decoder = options.read_info(File::open(out).unwrap()).unwrap();
    assert_eq!((decoder.width(), decoder.height()), (size.width(), size.height()));
    for number in 0..7 {
        let frame = decoder.read_next_frame().unwrap().unwrap();
        assert_eq!(frame.delay, 3);
        let shown: Vec<u8> = frame.buffer.chunks(4).flat_map(|pixel| pixel[..3].to_vec()).collect();
        assert_eq!(shown, picture(size, number));
    }
    assert!(decoder.read_next_frame().unwrap().is_none());
}

#[test]
fn a_webp_shows_every_frame_without_loss() {
    let (_directory, out, size) = film("film.webp", 5);
    let mut decoder = image_webp::WebPDecoder::new(io::BufReader::new(File::open(out).unwrap())).unwrap();
    assert_eq!(decoder.dimensions(), (size.width().into(), size.height().into()));
    assert_eq!((decoder.num_frames(), decoder.loop_duration()), (5, 150));
    let mut shown = vec![0; decoder.output_buffer_size().unwrap()];
    for number in 0..5 {
        assert_eq!(decoder.read_frame(&mut shown).unwrap(), 30);
        let channels = shown.len() / (size.bytes() / 3);
        let colours: Vec<u8> = shown.chunks(channels).flat_map(|pixel| pixel[..3].to_vec()).collect();
        assert_eq!(colours, picture(size, number));
    }
}

#[test]
fn a_contact_sheet_goes_from_begin_to_end_however_long_the_film() {
    for (frames, columns, rows) in [(1u8, 1, 1), (3, 3, 1), (5, 4, 2), (12, 4, 3)] {
        let (_directory, out, size) = film("film.png", frames);
        let mut image = png::Decoder::new(io::BufReader::new(File::open(out).unwrap())).read_info().unwrap();
        let (width, height) = (u32::from(size.width()), u32::from(size.height()));
        assert_eq!((image.info().width, image.info().height), (columns * width, rows * height), "{frames}");
        let mut pixels = vec![0; image.output_buffer_size().unwrap()];
        image.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels[..3], picture(size, 0)[..3]);
        let last = (3 * (width * ((u32::from(frames) - 1) % 4) + columns * width * height * (rows - 1))) as usize;
        assert_eq!(pixels[last..last + 3], picture(size, frames - 1)[..3]);
    }
}

#[test]
fn a_contact_sheet_keeps_few_frames_of_a_long_film_and_spreads_them() {
    let size = Size::new(16, 16).unwrap();
    let mut sheet = sheet::Sheet::new(tempfile::tempfile().unwrap(), size);
    for number in 0..1000u16 {
        let [low, high] = number.to_le_bytes();
        sheet.frame(&[low, high]).unwrap();
        assert!(sheet.kept() <= 24);
    }
    let shown: Vec<u16> = sheet.tiles().iter().map(|tile| u16::from_le_bytes([tile[0], tile[1]])).collect();
    assert_eq!((shown.len(), shown[0]), (12, 0));
    assert!(shown[11] >= 900, "{shown:?}");
    assert!(shown.windows(2).all(|pair| (60..=140).contains(&(pair[1] - pair[0]))), "{shown:?}");
}

#[test]
fn frame_times_that_are_no_whole_units_do_not_add_up() {
    let mut clock = Clock::new(Duration::from_secs_f64(1.0 / 30.0), Duration::from_millis(10));
    let units: Vec<u32> = (0..30).map(|_| clock.tick()).collect();
    assert_eq!(units.iter().sum::<u32>(), 100);
    assert!(units.iter().all(|unit| (3..=4).contains(unit)));
}

#[test]
fn an_unknown_extension_is_refused_with_the_known_ones() {
    for name in ["film.avi", "film", ".gif", "film.gif.txt"] {
        let error = Format::of(Path::new(name)).unwrap_err();
        assert!(error.is_configuration());
        let text = error.to_string();
        assert!([".gif", ".webp", ".mp4", ".png", name].iter().all(|part| text.contains(part)), "{text}");
    }
    assert_eq!(Format::of(Path::new("/tmp/FILM.GIF")).unwrap(), Format::Gif);
}

#[test]
fn a_missing_ffmpeg_is_named_with_what_helps() {
    let error = mp4::find(OsStr::new("/nowhere:/neither")).unwrap_err();
    assert!(error.is_configuration());
    let text = error.to_string();
    assert!(["ffmpeg", "PATH", "install", ".gif"].iter().all(|part| text.contains(part)), "{text}");
}

#[test]
fn a_film_that_is_not_finished_leaves_no_file() {
    let directory = tempfile::tempdir().unwrap();
    let size = Size::new(16, 16).unwrap();
    let mut movie = Movie::create(&directory.path().join("film.gif"), size, Duration::from_millis(30)).unwrap();
    movie.frame(&picture(size, 1)).unwrap();
    drop(movie);
    assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0);
}
