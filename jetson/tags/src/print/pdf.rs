//! Sheets as a PDF (ISO 32000-1).

use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str, TextStr};

use super::{Shape, Sheet};

/// Returns the sheets as a PDF, one per page.
pub fn pdf(title: &str, sheets: &[Sheet]) -> Vec<u8> {
    let mut next = 0;
    let mut reference = || {
        next += 1;
        Ref::new(next)
    };
    let (catalog, tree, font, info) = (reference(), reference(), reference(), reference());
    let pages: Vec<(Ref, Ref)> = sheets.iter().map(|_| (reference(), reference())).collect();
    let mut pdf = Pdf::new();
    let mut root = pdf.catalog(catalog);
    root.pages(tree);
    // Print dialogs that support this preference start at 100 %.
    root.viewer_preferences().pair(Name(b"PrintScaling"), Name(b"None"));
    root.finish();
    pdf.document_info(info).title(TextStr(title));
    pdf.pages(tree).kids(pages.iter().map(|&(page, _)| page)).count(pages.len() as i32);
    // One of the standard fonts of every PDF reader.
    pdf.type1_font(font).base_font(Name(b"Helvetica"));
    for (sheet, &(page_ref, content_ref)) in sheets.iter().zip(&pages) {
        let [width, height] = sheet.paper.size_mm();
        let mut page = pdf.page(page_ref);
        page.media_box(Rect::new(0.0, 0.0, points(width), points(height)));
        page.parent(tree);
        page.contents(content_ref);
        page.resources().fonts().pair(FONT, font);
        page.finish();
        pdf.stream(content_ref, &draw(sheet));
    }
    pdf.finish()
}

fn draw(sheet: &Sheet) -> Vec<u8> {
    let mut content = Content::new();
    for shape in &sheet.shapes {
        match shape {
            Shape::Boxes(boxes) => {
                content.set_fill_gray(0.0);
                for &[left, low, width, height] in boxes {
                    content.rect(points(left), points(low), points(width), points(height));
                }
                content.fill_nonzero();
            }
            Shape::Line { from, to, fold } => {
                content.set_stroke_gray(0.55).set_line_width(0.4);
                content.set_dash_pattern(
                    if *fold { &[3.0, 3.0][..] } else { &[] }.iter().copied(),
                    0.0,
                );
                content.move_to(points(from[0]), points(from[1]));
                content.line_to(points(to[0]), points(to[1]));
                content.stroke();
            }
            Shape::Text { at, size, text } => {
                content.set_fill_gray(0.35).begin_text();
                // The capitals of Helvetica have 0.72 of the font size.
                content.set_font(FONT, points(size / 0.72));
                content.next_line(points(at[0]), points(at[1]));
                content.show(Str(text.as_bytes())).end_text();
            }
        }
    }
    content.finish().into_vec()
}

/// Converts to PDF's unit of length, 1/72 inch.
fn points(mm: f64) -> f32 {
    (mm * 72.0 / 25.4) as f32
}

const FONT: Name<'static> = Name(b"F1");
