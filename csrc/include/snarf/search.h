// Constants of the searches that the CPU and the CUDA kernels share.
#pragma once

#include "platform.h"

namespace snarf {

// A cell with a curvature (cell.h) up to this is solved from one start; others are cut into eight.
constexpr double kTame = 0.9;
// How often; a part that still is not tame then gets several starts.
constexpr int kLevels = 4;
// The starts of such a part: its eight corners, its centre, and the affine guess, which alone is enough for a tame one.
constexpr int kStarts = 10;
constexpr int kCentreStart = 8, kAffineStart = 9;

// Shares of a cell's shortest side within which two reports are of one root: Newton's errors are far smaller, Broyden's roots
// are only as exact as the tolerance.
constexpr double kSameRoot = 5e-3;
constexpr double kSameBroydenRoot = 5e-2;

}  // namespace snarf
