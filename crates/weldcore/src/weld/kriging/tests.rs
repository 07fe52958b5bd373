//! The elimination against dense matrices with the exact covariance.

use nalgebra::{DMatrix, DVector};

use super::basis::matern;
use super::chain::correlation;
use super::*;
use crate::ground::random::mix;
use crate::ground::threads;

/// A tenth of a standard deviation, as shares of u: rank, and cells off their columns.
const VALUE_TOLERANCE: f64 = 0.08;
const SPREAD_TOLERANCE: f64 = 0.015;
const COST_TOLERANCE: f64 = 1.0;

fn uniform(k: u64) -> f64 {
    (mix(k) >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
}

struct Case {
    line: SeamLine,
    walls: [KrigedWall; 2],
    columns: [BorderColumns; 2],
    size: usize,
    scales: [Scales; 2],
}

/// Two walls of two shots, with a level and a slope of each shot (both walls), and one step.
fn case(closed: bool) -> Case {
    let line = SeamLine { columns: 24, spacing_mm: 5.0, closed };
    let width = [Width { common: 1, of_a_shot: 2, shots: 2 }, Width { common: 2, of_a_shot: 2, shots: 2 }];
    let rows_mm = |sign: f64| (0..8).map(|k| sign * (5.0 * f64::from(k))).collect::<Vec<f64>>();
    let mut seed = 1;
    let mut next = || {
        seed += 1;
        uniform(seed)
    };
    let wall = |k: usize, next: &mut dyn FnMut() -> f64| {
        let sign = if k == 0 { -1.0 } else { 1.0 };
        let mut cells = Vec::new();
        for shot in 0..2 {
            for column in 10 * shot..10 * shot + 14 {
                for row in 2..8 {
                    cells.push(Cell {
                        column,
                        along_mm: 0.5 * next(),
                        across_mm: sign * (5.0 * f64::from(row) + next()),
                        height_mm: 0.05 * next() + 0.01 * k as f64,
                        weight: 2e4 * (1.0 + next()),
                        shot,
                    });
                }
            }
        }
        KrigedWall::new(cells, width[k], rows_mm(sign), |cell, out| {
            // A term common to both walls; the step on the other one; level and lean of the shot.
            out[0] = 0.3 * (cell.column as f64 / 4.0).sin();
            if k == 1 {
                out[1] = 3.0;
            }
            let at = width[k].common;
            (out[at], out[at + 1]) = (0.5, 0.02 * cell.across_mm);
        })
    };
    let walls = [wall(0, &mut next), wall(1, &mut next)];
    let one = |k: usize| vec![k];
    let columns = [vec![one(0), one(2), one(3), one(4), one(5)], vec![one(0), one(1), one(2), one(3), one(4), one(5)]];
    let scales = [
        Scales { sd_mm: 0.02, along_mm: 30.0, across_mm: 40.0, noise: 1.3 },
        Scales { sd_mm: 0.05, along_mm: 12.0, across_mm: 25.0, noise: 0.8 },
    ];
    Case { line, walls, columns, size: 6, scales }
}

fn asked(other: bool) -> Vec<Asked> {
    let factor = if other { 1.0 } else { -1.0 };
    [2, 5, 6, 12, 20].map(|column| Asked { column, across_mm: 0.0, factor }).to_vec()
}

fn by_sweeps(case: &Case) -> (Border, Answer) {
    let reduced: Vec<Reduced> =
        (0..2).map(|k| sweep(&case.line, &case.walls[k], &case.scales[k], &asked(k == 1)).unwrap()).collect();
    let walls = [(&reduced[0], &case.columns[0]), (&reduced[1], &case.columns[1])];
    let border = Border::join(case.size, &walls).unwrap();
    let mut rows = vec![0.0; 5 * case.size];
    (0..5).for_each(|k| rows[k * case.size + 1] = 3.0);
    let answer = border.answer(&rows, &walls);
    (border, answer)
}

/// The same by one dense covariance of all cells.
fn dense(case: &Case) -> (f64, DVector<f64>, DMatrix<f64>) {
    let counts = [case.walls[0].count(), case.walls[1].count()];
    let n = counts[0] + counts[1];
    let girth = case.line.columns as f64 * case.line.spacing_mm;
    let along = |d: f64, length: f64| {
        if !case.line.closed {
            return correlation(d, length);
        }
        // The chain that closes is the sum of its images.
        (-40..=40).map(|k| correlation(d + f64::from(k) * girth, length)).sum()
    };
    let place = |c: &Cell| c.column as f64 * case.line.spacing_mm + c.along_mm;
    let mut v = DMatrix::zeros(n, n);
    let mut x = DMatrix::zeros(n, case.size);
    let mut y = DVector::zeros(n);
    let mut k0 = DMatrix::zeros(5, n);
    let mut k00 = DMatrix::zeros(5, 5);
    for (w, wall) in case.walls.iter().enumerate() {
        let scales = &case.scales[w];
        let kernel = |d: f64, z: f64| scales.sd_mm.powi(2) * along(d, scales.along_mm) * matern(z, scales.across_mm);
        let first = w * counts[0];
        let held = wall.width.common + wall.width.of_a_shot;
        for (i, a) in wall.cells().iter().enumerate() {
            for (j, b) in wall.cells().iter().enumerate() {
                v[(first + i, first + j)] = kernel(place(a) - place(b), a.across_mm - b.across_mm);
            }
            v[(first + i, first + i)] += scales.noise / a.weight;
            y[first + i] = a.height_mm;
            for k in 0..held {
                let own = if k < wall.width.common { k } else { wall.width.of_shot(a.shot) + k - wall.width.common };
                for &p in &case.columns[w][own] {
                    x[(first + i, p)] += wall.rows[i * held + k];
                }
            }
            for (q, ask) in asked(w == 1).iter().enumerate() {
                let d = place(a) - ask.column as f64 * case.line.spacing_mm;
                k0[(q, first + i)] = ask.factor * kernel(d, a.across_mm);
            }
        }
        for (p, a) in asked(w == 1).iter().enumerate() {
            for (q, b) in asked(w == 1).iter().enumerate() {
                let d = (a.column as f64 - b.column as f64) * case.line.spacing_mm;
                k00[(p, q)] += kernel(d, 0.0);
            }
        }
    }
    let mut x0 = DMatrix::zeros(5, case.size);
    x0.column_mut(1).fill(3.0);
    let factor = v.cholesky().unwrap();
    let s = DMatrix::identity(case.size, case.size) + x.tr_mul(&factor.solve(&x));
    let b = s.clone().cholesky().unwrap().solve(&x.tr_mul(&factor.solve(&y)));
    let log_det = 2.0 * factor.l().diagonal().iter().map(|d| d.ln()).sum::<f64>();
    let rest = &y - &x * &b;
    let cost = log_det + s.determinant().ln() + rest.dot(&factor.solve(&rest)) + b.norm_squared();
    let h = &x0 * &b + &k0 * factor.solve(&rest);
    let left = &x0 - &k0 * factor.solve(&x);
    let c = k00 - &k0 * factor.solve(&k0.transpose()) + &left * s.cholesky().unwrap().solve(&left.transpose());
    (cost, h, c)
}

fn both(case: &Case, prior: &Prior) -> Option<[Scales; 2]> {
    let (walls, columns) = ([&case.walls[0], &case.walls[1]], [&case.columns[0], &case.columns[1]]);
    fit(&[Stretch::new(case.line, walls, columns, case.size)], [prior, prior])
}

#[test]
fn elimination_is_dense_kriging() {
    for closed in [false, true] {
        let case = case(closed);
        let (border, answer) = by_sweeps(&case);
        let (cost, h, c) = dense(&case);
        assert!((border.cost - cost).abs() < COST_TOLERANCE, "closed {closed}: {} is not {cost}", border.cost);
        for i in 0..5 {
            let u = c[(i, i)].sqrt();
            assert!((answer.value[i] - h[i]).abs() < VALUE_TOLERANCE * u, "{closed} {i}: {} {}", answer.value[i], h[i]);
            for j in 0..5 {
                let off = (answer.covariance[i * 5 + j] - c[(i, j)]).abs();
                assert!(off < 2.0 * SPREAD_TOLERANCE * (c[(i, i)] * c[(j, j)]).sqrt(), "{closed} {i} {j}: {off}");
            }
            assert!(answer.of_unevenness[i] < answer.covariance[i * 5 + i]);
        }
    }
}

#[test]
fn a_turned_border_costs_the_same_at_all_scales() {
    let case = case(false);
    let (walls, columns) = ([&case.walls[0], &case.walls[1]], [&case.columns[0], &case.columns[1]]);
    let turned = Stretch::new(case.line, walls, columns, case.size + 2);
    let size = turned.walls[0].width.common;
    assert_eq!(size, case.size, "two unknowns that no cell tells are left out");
    let mine: BorderColumns = (0..size).map(|k| vec![k]).collect();
    let costs = [0.5, 1.0, 2.0].map(|factor| {
        let of = |line: &SeamLine, walls: [&KrigedWall; 2], columns: [&BorderColumns; 2], size: usize| {
            let scales = case.scales.map(|s| Scales { sd_mm: factor * s.sd_mm, ..s });
            let reduced = [0, 1].map(|k| sweep(line, walls[k], &scales[k], &[]).unwrap());
            Border::join(size, &[(&reduced[0], columns[0]), (&reduced[1], columns[1])]).unwrap().cost
        };
        of(&turned.line, [&turned.walls[0], &turned.walls[1]], [&mine, &mine], size)
            - of(&case.line, walls, columns, case.size)
    });
    // Not quite: rows without cells carry nothing any more.
    assert!(costs.iter().all(|c| (c - costs[0]).abs() < COST_TOLERANCE), "{costs:?}");
    // And with all variances of a wall larger by a factor.
    let noisier = |log_factor: f64| {
        let factor = f64::exp(log_factor);
        let scales = [case.scales[0], Scales { sd_mm: factor.sqrt() * case.scales[1].sd_mm, ..case.scales[1] }];
        let scales = [scales[0], Scales { noise: factor * scales[1].noise, ..scales[1] }];
        [0, 1].map(|k| sweep(&turned.line, &turned.walls[k], &scales[k], &[]).unwrap())
    };
    let ([first, once], [_, twice]) = (noisier(0.0), noisier(0.7));
    let whole = Border::join(size, &[(&first, &mine), (&twice, &mine)]).unwrap();
    let scaled = super::border::Scaled::new(&once, Some(&first)).cost(0.7).unwrap();
    assert!((whole.cost - scaled).abs() < 1e-6, "{} is not {scaled}", whole.cost);
}

#[test]
fn the_likeliest_scales_are_those_that_walls_were_drawn_from() {
    // Walls drawn through the Cholesky factor of their exact covariance.
    let mut case = case(false);
    let girth = case.line.spacing_mm;
    let mut found = [[0.0; 4]; 2];
    let runs = 6;
    for run in 0..runs {
        for w in 0..2 {
            let scales = case.scales[w];
            let wall = case.walls[w].clone();
            let place = |c: &Cell| c.column as f64 * girth + c.along_mm;
            let n = wall.count();
            let v = DMatrix::from_fn(n, n, |i, j| {
                let (a, b) = (&wall.cells()[i], &wall.cells()[j]);
                let own = if i == j { scales.noise / a.weight } else { 0.0 };
                let along = correlation(place(a) - place(b), scales.along_mm);
                own + scales.sd_mm.powi(2) * along * matern(a.across_mm - b.across_mm, scales.across_mm)
            });
            let g = DVector::from_fn(n, |i, _| {
                f64::from(crate::ground::random::normals().draw(mix(1000 * (run * 2 + w) as u64 + i as u64)))
            });
            let y = v.cholesky().unwrap().l() * g;
            let cells =
                wall.cells().iter().zip(y.iter()).map(|(c, y)| Cell { height_mm: *y, ..*c }).collect::<Vec<Cell>>();
            let held = wall.width.common + wall.width.of_a_shot;
            let rows = wall.rows.clone();
            let row = std::cell::Cell::new(0);
            case.walls[w] = KrigedWall::new(cells, wall.width, wall.rows_mm.clone(), |_, out| {
                out.copy_from_slice(&rows[row.get() * held..][..held]);
                row.set(row.get() + 1);
            });
        }
        let prior = Prior::of_walls([5.0, 5.0], [120.0, 40.0]);
        let scales = both(&case, &prior).unwrap();
        for (sums, s) in found.iter_mut().zip(scales) {
            let logs = [s.sd_mm, s.along_mm, s.across_mm, s.noise].map(f64::ln);
            sums.iter_mut().zip(logs).for_each(|(sum, l)| *sum += l / runs as f64);
        }
    }
    for (found, scales) in found.iter().zip(case.scales) {
        let found = found.map(f64::exp);
        // A few waves a wall: their scales are known to a third or so, the noise to a few per cent.
        for (f, s) in found.iter().zip([scales.sd_mm, scales.along_mm, scales.across_mm]) {
            assert!((0.6..1.6).contains(&(f / s)), "{found:?} are not {scales:?}");
        }
        assert!((0.85..1.18).contains(&(found[3] / scales.noise)), "{found:?} are not {scales:?}");
    }
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let case = case(true);
    let mut seen = Vec::new();
    for n in [1, 2, 8] {
        threads::set_threads(Some(n)).unwrap();
        let prior = Prior::of_walls([5.0, 5.0], [120.0, 40.0]);
        let scales = both(&case, &prior);
        let answer = by_sweeps(&case).1;
        seen.push((scales, largest(&answer.value, &answer.covariance)));
    }
    threads::set_threads(None).unwrap();
    assert!(seen.windows(2).all(|w| w[0] == w[1]) && seen[0].0.is_some() && seen[0].1.is_some());
}
