use super::*;
use crate::layout::{LayoutFrame, Tag};
use glam::{DVec2, DVec3};

fn cube() -> Cube {
    Cube {
        family: TagFamily::Tag36h11,
        first_id: 4,
        faces: 5,
        face_mm: 160.0,
        tag_mm: 120.0,
        middle_m: DVec3::new(0.0, 0.0, 0.1),
        paper: Paper::A4,
        bar_mm: BAR_MM,
    }
}

fn mat() -> Mat {
    Mat {
        family: TagFamily::Tag36h11,
        first_id: 100,
        columns: 3,
        rows: 4,
        pitch_mm: 90.0,
        tag_mm: 60.0,
        middle_m: DVec3::ZERO,
        paper: Paper::A4,
        bar_mm: BAR_MM,
    }
}

/// Returns whether a black box covers a point of a sheet.
fn is_black(sheet: &Sheet, [x, y]: [f64; 2]) -> bool {
    sheet.shapes.iter().any(|shape| match shape {
        Shape::Boxes(boxes) => {
            boxes.iter().any(|&[l, b, w, h]| (l..l + w).contains(&x) && (b..b + h).contains(&y))
        }
        _ => false,
    })
}

#[test]
fn places_and_draws_the_tags_of_a_cube() {
    let printed = cube().print().unwrap();
    assert_eq!(printed.sheets.len(), 5);
    assert_eq!(printed.layout.frame, LayoutFrame::Body);
    printed.layout.validate().unwrap();
    for (tag, (name, out, up)) in printed.layout.tags.iter().zip(CUBE_FACES) {
        assert!((tag.normal() - out).length() < 1e-12, "{name}");
        assert!((tag.position_m - DVec3::Z * 0.1 - out * 0.08).length() < 1e-12, "{name}");
        assert!((tag.rotation_xyzw * DVec3::Y - up).length() < 1e-12, "{name}");
        assert_eq!(tag.size_m, 0.12);
    }
    let cells = TagFamily::Tag36h11.cells(4).unwrap();
    // Middle of the sheet's only face: margin, flap and half a face from the left and, above the foot, from below.
    let [x, y] = [10.0 + 8.0 + 80.0, 10.0 + 18.0 + 8.0 + 80.0];
    for row in 0..10 {
        for column in 0..10 {
            let at = |i: u32| (f64::from(i) + 0.5 - 5.0) * 15.0;
            let black = is_black(&printed.sheets[0], [x + at(column), y - at(row)]);
            assert_eq!(black, !cells.is_white(column, row), "column {column}, row {row}");
        }
    }
}

#[test]
fn splits_a_mat_over_sheets_with_each_tag_once() {
    let printed = mat().print().unwrap();
    // A sheet of 190 x 259 mm has two by two tags.
    assert_eq!(printed.sheets.len(), 4);
    let tags = &printed.layout.tags;
    assert_eq!(tags.iter().map(|tag| tag.id).collect::<Vec<_>>(), (100..112).collect::<Vec<_>>());
    assert!((tags[0].position_m - DVec3::new(-0.09, -0.135, 0.0)).length() < 1e-12);
    assert!((tags[11].position_m - DVec3::new(0.09, 0.135, 0.0)).length() < 1e-12);
    printed.layout.validate().unwrap();
    let drawn: usize = printed
        .sheets
        .iter()
        .map(|sheet| sheet.shapes.iter().filter(|s| matches!(s, Shape::Boxes(_))).count() - 1)
        .sum();
    assert_eq!(drawn, 12);
    let has_text = |sheet: &Sheet, part: &str| {
        sheet.shapes.iter().any(|s| matches!(s, Shape::Text { text, .. } if text.contains(part)))
    };
    assert!(has_text(
        &printed.sheets[0],
        "tag36h11 100 to 101, ..., 103 to 104; cut along the marks"
    ));
    let whole = Mat { columns: 2, rows: 2, ..mat() }.print().unwrap();
    assert!(has_text(&whole.sheets[0], "tag36h11 100 to 103; this edge is north"));
}

#[test]
fn bar_length_scales_the_layout_only() {
    let printed = Mat { bar_mm: 98.0, ..mat() }.print().unwrap();
    let tags = &printed.layout.tags;
    assert!((tags[0].size_m - 0.0588).abs() < 1e-12);
    assert!((tags[1].position_m - tags[0].position_m - DVec3::X * 0.0882).length() < 1e-12);
    // The sheets are unchanged, because they are already printed.
    assert_eq!(printed.sheets, mat().print().unwrap().sheets);
}

#[test]
fn board_fills_one_sheet_within_the_paper() {
    for paper in [Paper::A4, Paper::Letter, Paper::A3] {
        for family in TagFamily::ALL {
            let board = Mat::board(family, 0, 30.0, paper, BAR_MM).unwrap();
            let count = board.columns * board.rows;
            if count > family.ids() {
                assert!(matches!(board.print(), Err(PrintError::Ids { .. })));
                continue;
            }
            let printed = board.print().unwrap();
            assert_eq!(printed.sheets.len(), 1, "{family} on {paper}");
            let [width, height] = paper.size_mm();
            let inside = |x: f64, y: f64| (0.0..=width).contains(&x) && (0.0..=height).contains(&y);
            for shape in &printed.sheets[0].shapes {
                match shape {
                    Shape::Boxes(boxes) => {
                        assert!(
                            boxes
                                .iter()
                                .all(|b| inside(b[0], b[1]) && inside(b[0] + b[2], b[1] + b[3]))
                        );
                    }
                    Shape::Line { from, to, .. } => {
                        assert!(inside(from[0], from[1]) && inside(to[0], to[1]));
                    }
                    // Letters of Helvetica are on average half as wide as high.
                    Shape::Text { at, size, text } => {
                        let end = at[0] + text.len() as f64 * size * 0.55;
                        assert!(inside(at[0], at[1]) && inside(end, at[1]), "{text}");
                    }
                }
            }
        }
    }
}

#[test]
fn rejects_invalid_sheets_with_the_reason() {
    let refused = |result: Result<Printed, PrintError>, parts: &[&str]| {
        let error = result.unwrap_err().to_string();
        for part in parts {
            assert!(error.contains(part), "{error:?} lacks {part:?}");
        }
    };
    refused(Cube { face_mm: 200.0, ..cube() }.print(), &["200 mm", "A4", "174 mm"]);
    refused(Cube { tag_mm: 140.0, ..cube() }.print(), &["140.0 mm", "175.0 mm", "160.0 mm"]);
    refused(Cube { first_id: 583, ..cube() }.print(), &["tag36h11", "0 to 586", "583"]);
    refused(Cube { faces: 7, ..cube() }.print(), &["faces = 7"]);
    refused(Cube { bar_mm: 10.0, ..cube() }.print(), &["bar_mm = 10", "90 to 110"]);
    refused(Cube { tag_mm: f64::NAN, ..cube() }.print(), &["tag_mm = NaN"]);
    refused(Mat { pitch_mm: 60.0, ..mat() }.print(), &["75.0 mm", "from tag to tag"]);
    refused(Mat { columns: 100_000, rows: 100_000, ..mat() }.print(), &["too many"]);
    refused(Mat { pitch_mm: 300.0, ..mat() }.print(), &["300 mm", "190 mm"]);
}

#[test]
fn sizes_a_mat_for_the_hall() {
    let check = |hall_m: [f64; 3], tag_mm: f64, paper: Paper| {
        let middle_m = DVec3::ZERO;
        let (mat, px) =
            Mat::for_hall(hall_m.into(), TagFamily::Tag36h11, 100, middle_m, BAR_MM).unwrap();
        assert_eq!((mat.tag_mm, mat.paper), (tag_mm, paper), "{hall_m:?}");
        assert!(px >= 25.0 || tag_mm == 200.0, "{px}");
        assert_eq!(mat.print().unwrap().layout.tags.len(), 8);
    };
    check([11.0, 4.5, 3.65], 200.0, Paper::A3);
    check([5.0, 4.0, 2.5], 120.0, Paper::A4);
    check([30.0, 20.0, 8.0], 200.0, Paper::A3);
    let none = DVec3::new(f64::NAN, 4.0, 3.0);
    assert!(Mat::for_hall(none, TagFamily::Tag36h11, 100, DVec3::ZERO, BAR_MM).is_err());
}

#[test]
fn floor_has_large_tags_and_pads_of_small_tags() {
    let pad = Pad { middle_m: DVec2::new(-0.4, 0.1), size_m: Pad::SIZE_M };
    let floor = Floor {
        family: TagFamily::Tag36h11,
        first_id: 100,
        size_m: DVec2::new(3.0, 2.5),
        middle_m: DVec3::ZERO,
        pads: vec![pad],
        bar_mm: 99.0,
    };
    let printed = floor.print().unwrap();
    printed.layout.validate().unwrap();
    let tags = &printed.layout.tags;
    let ids: Vec<u32> = tags.iter().map(|tag| tag.id).collect();
    assert_eq!(ids, (100..100 + tags.len() as u32).collect::<Vec<_>>());
    let (large, small): (Vec<&Tag>, Vec<&Tag>) = tags.iter().partition(|tag| tag.size_m > 0.1);
    // The pad covers two of the six by five large tags. It has two sheets of five by seven tags.
    assert_eq!((large.len(), small.len(), printed.sheets.len()), (28, 70, 30));
    // Printer scaling changes the size of tags, but not positions measured with a tape.
    assert!((large[0].size_m - 0.198).abs() < 1e-12);
    assert!((large[0].position_m - DVec3::new(-1.25, -1.0, 0.0)).length() < 1e-12);
    let middle_m = small.iter().map(|tag| tag.position_m).sum::<DVec3>() / 70.0;
    assert!((middle_m - pad.middle_m.extend(0.0)).length() < 1e-12);
    assert!((small[1].position_m.x - small[0].position_m.x - 0.053 * 0.99).abs() < 1e-12);
    // Sheets do not overlap.
    for (i, tag) in tags.iter().enumerate() {
        for other in &tags[..i] {
            let gap_m = (tag.position_m - other.position_m).abs().max_element();
            let needed_m = 0.625 * (tag.size_m + other.size_m);
            assert!(gap_m >= needed_m - 1e-9, "tags {} and {}", tag.id, other.id);
        }
    }
    assert_eq!((floor.pads()[0].first_id, floor.pads()[0].columns), (128, 10));
    let error = Floor { size_m: DVec2::new(30.0, 20.0), ..floor.clone() }.print().unwrap_err();
    assert!(error.to_string().contains("too many"), "{error}");
    let error = Floor { size_m: DVec2::new(30.0, 0.2), ..floor }.print().unwrap_err().to_string();
    assert!(error.contains("fly_over = 0.2"), "{error}");
}

#[test]
fn pdf_has_a_page_of_the_paper_size_per_sheet() {
    let printed = mat().print().unwrap();
    let bytes = pdf("mat", &printed.sheets);
    let text = String::from_utf8_lossy(&bytes);
    assert!(text.starts_with("%PDF-"));
    assert_eq!(text.matches("/MediaBox [0 0 595.2756 841.8898]").count(), 4);
    assert!(text.contains("/Count 4") && text.contains("/PrintScaling /None"));
}
