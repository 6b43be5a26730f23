//! Palette of few vectors that approximates many: the harmonics of a scene.

/// Palette entries, concatenated, and for each vector of the scene the index of its entry.
pub(super) struct Palette {
    pub(super) entries: Vec<f32>,
    pub(super) labels: Vec<u16>,
}

/// Returns a palette of at most `most` entries for `vectors` of `dimensions` numbers each. The set
/// is halved repeatedly at the median of its widest dimension; each entry is the mean of one
/// remaining part (median cut for colour palettes; Heckbert, SIGGRAPH 1982).
///
/// # Panics
/// If `most` exceeds the range of a label.
pub(super) fn build(vectors: &[f32], dimensions: usize, most: usize) -> Palette {
    assert!(most <= 1 << 16);
    let count = vectors.len() / dimensions;
    let mut order: Vec<u32> = (0..count as u32).collect();
    let mut palette = Palette { entries: Vec::new(), labels: vec![0; count] };
    let vector = |i: u32| &vectors[i as usize * dimensions..][..dimensions];

    // Runs of `order` that are still to be split, and the number of entries for each.
    let mut open = vec![(0..count, most)];
    let mut means = vec![0f64; dimensions];
    let mut squares = vec![0f64; dimensions];
    while let Some((run, share)) = open.pop() {
        if run.is_empty() {
            continue;
        }
        means.fill(0.0);
        squares.fill(0.0);
        for &i in &order[run.clone()] {
            for (k, &value) in vector(i).iter().enumerate() {
                means[k] += f64::from(value);
                squares[k] += f64::from(value) * f64::from(value);
            }
        }
        let length = run.len() as f64;
        let variance = |k: usize| squares[k] / length - (means[k] / length).powi(2);
        let widest = (0..dimensions).max_by(|&a, &b| variance(a).total_cmp(&variance(b)));
        match widest {
            Some(k) if share > 1 && run.len() > 1 && variance(k) > 0.0 => {
                let middle = run.len() / 2;
                order[run.clone()]
                    .select_nth_unstable_by(middle, |&a, &b| vector(a)[k].total_cmp(&vector(b)[k]));
                let cut = run.start + middle;
                open.push((cut..run.end, share / 2));
                open.push((run.start..cut, share - share / 2));
            }
            _ => {
                let label = (palette.entries.len() / dimensions) as u16;
                palette.entries.extend(means.iter().map(|sum| (sum / length) as f32));
                order[run].iter().for_each(|&i| palette.labels[i as usize] = label);
            }
        }
    }
    palette
}

#[cfg(test)]
mod tests {
    use super::build;

    #[test]
    fn keeps_vectors_exactly_if_the_palette_is_large_enough() {
        let vectors: Vec<f32> = (0..30).map(|i| ((i * 7) % 11) as f32).collect();
        let palette = build(&vectors, 3, 16);
        for (vector, &label) in vectors.chunks(3).zip(&palette.labels) {
            assert_eq!(vector, &palette.entries[usize::from(label) * 3..][..3]);
        }
        assert!(build(&[], 3, 16).labels.is_empty());
    }

    #[test]
    fn maps_many_vectors_to_a_near_entry() {
        // Two clusters of many vectors.
        let vectors: Vec<f32> =
            (0..2000).map(|i| (i % 2) as f32 * 10.0 + (i / 2) as f32 * 1e-4).collect();
        let palette = build(&vectors, 1, 4);
        assert_eq!(palette.entries.len(), 4);
        for (value, &label) in vectors.iter().zip(&palette.labels) {
            assert!((value - palette.entries[usize::from(label)]).abs() < 0.1);
        }
    }
}
