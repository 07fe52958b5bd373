//! Grey PNG images, read strictly: a scan that lost half an image must not be measured as a scan of something dark.
//!
//! Every check sum is verified, the stream must reach its end, and whatever is not one grey channel of 8 or 16 bits is
//! refused. (The `png` crate inflates camera noise in a third of libpng's time.)

use png::{BitDepth, ColorType, Decoder, DecodingError};
use std::io::{Cursor, ErrorKind};

use crate::error::{Error, Result};

/// The pixels of an image, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Pixels {
    /// 8 bits.
    U8(Vec<u8>),
    /// 16 bits.
    U16(Vec<u16>),
}

/// A grey image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GreyImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Row-major.
    pub pixels: Pixels,
}

/// More pixels than any camera has; below it, a buffer is made before the file has proved that it fills it.
const MAX_PIXELS: usize = 1 << 28;

/// Decodes a grey PNG of 8 or 16 bits.
///
/// `size`: columns and rows that it must have. The error says what the file is and what it should be.
pub fn decode_png(data: &[u8], size: Option<[usize; 2]>) -> Result<GreyImage> {
    let wrong = |reason: String| Error::Image { reason };
    if data.is_empty() {
        return Err(wrong("is empty".into()));
    }
    if !data.starts_with(b"\x89PNG\r\n\x1a\n") {
        return Err(wrong("is not a PNG image".into()));
    }
    let failed = |error: DecodingError| match error {
        DecodingError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => {
            wrong(format!("is truncated: the PNG breaks off after {} bytes", data.len()))
        }
        other => wrong(format!("is a damaged PNG: {}", other.to_string().trim_end_matches('.'))),
    };
    let mut decoder = Decoder::new(Cursor::new(data));
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(failed)?;
    let info = reader.info();
    let (width, height) = (info.width as usize, info.height as usize);
    let kind = match info.color_type {
        ColorType::Grayscale => None,
        ColorType::Rgb => Some("colour"),
        ColorType::Indexed => Some("colour (a palette)"),
        ColorType::GrayscaleAlpha => Some("grey with transparency"),
        ColorType::Rgba => Some("colour with transparency"),
    };
    if let Some(kind) = kind {
        return Err(wrong(format!("is {kind}, but should be grey (one channel)")));
    }
    let depth = info.bit_depth;
    if !matches!(depth, BitDepth::Eight | BitDepth::Sixteen) {
        return Err(wrong(format!("is of {} bits, but should be of 8 or 16", depth as u8)));
    }
    if let Some([columns, rows]) = size
        && (width, height) != (columns, rows)
    {
        return Err(wrong(format!("is {width}x{height} pixels, but the camera has {columns}x{rows}")));
    }
    let bytes = reader
        .output_buffer_size()
        .filter(|_| width.checked_mul(height).is_some_and(|n| n <= MAX_PIXELS))
        .ok_or_else(|| wrong(format!("is {width}x{height} pixels: too many")))?;
    crate::ground::memory::require(bytes, 2);
    let mut buffer = vec![0; bytes];
    reader.next_frame(&mut buffer).map_err(failed)?;
    reader.finish().map_err(failed)?;
    let pixels = match depth {
        BitDepth::Sixteen => {
            Pixels::U16(buffer.as_chunks::<2>().0.iter().map(|pair| u16::from_be_bytes(*pair)).collect())
        }
        _ => Pixels::U8(buffer),
    };
    Ok(GreyImage { width, height, pixels })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn encoded(width: u32, height: u32, colour: ColorType, depth: BitDepth, data: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, width, height);
        encoder.set_color(colour);
        encoder.set_depth(depth);
        encoder.write_header().unwrap().write_image_data(data).unwrap();
        out
    }

    fn complaint(data: &[u8], size: Option<[usize; 2]>) -> String {
        decode_png(data, size).unwrap_err().to_string()
    }

    #[test]
    fn what_was_encoded_comes_back() {
        let noise: Vec<u8> = (0..7 * 5).map(|i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let image = decode_png(&encoded(7, 5, ColorType::Grayscale, BitDepth::Eight, &noise), Some([7, 5])).unwrap();
        assert_eq!(image, GreyImage { width: 7, height: 5, pixels: Pixels::U8(noise) });
        let deep = [0x12, 0x34, 0xff, 0x00];
        let image = decode_png(&encoded(2, 1, ColorType::Grayscale, BitDepth::Sixteen, &deep), None).unwrap();
        assert_eq!(image.pixels, Pixels::U16(vec![0x1234, 0xff00]));
    }

    #[test]
    fn what_is_not_grey_or_not_of_the_size_is_named() {
        let rgb = encoded(2, 2, ColorType::Rgb, BitDepth::Eight, &[9; 12]);
        assert_eq!(complaint(&rgb, None), "is colour, but should be grey (one channel)");
        let bits = encoded(8, 1, ColorType::Grayscale, BitDepth::One, &[9]);
        assert_eq!(complaint(&bits, None), "is of 1 bits, but should be of 8 or 16");
        let grey = encoded(2, 3, ColorType::Grayscale, BitDepth::Eight, &[9; 6]);
        assert_eq!(complaint(&grey, Some([3, 2])), "is 2x3 pixels, but the camera has 3x2");
        assert_eq!(complaint(b"", None), "is empty");
        assert_eq!(complaint(b"GIF89a", None), "is not a PNG image");
    }

    #[test]
    fn every_cut_is_found() {
        let whole = encoded(9, 9, ColorType::Grayscale, BitDepth::Eight, &[77; 81]);
        for cut in 9..whole.len() {
            let said = complaint(&whole[..cut], Some([9, 9]));
            assert!(said.starts_with("is truncated") || said.starts_with("is a damaged PNG"), "{cut}: {said}");
        }
    }

    proptest! {
        #[test]
        fn no_damage_panics_or_passes_unseen(at in 8_usize..100, to: u8, cut in 0_usize..200) {
            let whole = encoded(9, 9, ColorType::Grayscale, BitDepth::Eight, &[77; 81]);
            let mut damaged = whole.clone();
            let at = at % whole.len();
            damaged[at] = to;
            damaged.truncate(cut.max(1));
            if let Ok(image) = decode_png(&damaged, Some([9, 9])) {
                prop_assert_eq!(image.pixels, Pixels::U8(vec![77; 81]));
            }
        }

        #[test]
        fn no_bytes_panic(bytes: Vec<u8>) {
            let _ = decode_png(&bytes, None);
            let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
            png.extend(bytes);
            let _ = decode_png(&png, None);
        }
    }
}
