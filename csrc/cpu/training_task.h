// What the library passes to the kernels of a training step (training.cpp), compiled once per instruction set. Plain data only.
#pragma once

#include <stdint.h>

#include "network_task.h"

namespace snarf {

// A network with gradients: NetworkLayer for the way forward, and for the way back copies of the same weights.
struct TrainedLayer {
  NetworkLayer forward;
  const float* back;     // [outputs, back_stride]: columns of the hidden inputs, of the first inputs, of the extras
  int32_t back_stride;   // each group of columns starts at a multiple of kOutputs and is padded to one
  int32_t real_outputs;  // outputs without padding
  int64_t saved;         // where its activations start in a tile's saved values
  int64_t weights_at;    // where its weight gradient [outputs, columns] starts in a chunk's gradients
  int64_t bias_at;       // and its bias gradient [outputs]
  int32_t columns;       // inputs, padded to a whole pack of any instruction set
};

struct TrainingTask {
  const TrainedLayer* layers;
  int32_t layer_count;
  int32_t widest;       // most outputs or columns of a layer, padded
  int32_t first_count;  // E, inputs of the first layer and of those that take them again
  int32_t extra_count;  // X
  float sharpness;      // of the softplus
  int64_t count;        // N
  const float* first;   // [N, E]
  const float* extras;  // [N, X]
  float* saved;         // [tiles, saved_size]: activations of the hidden layers, [outputs, kTile] each
  int64_t saved_size;
  float* out;             // [N, O], on the way forward
  const float* v_out;     // [N, O], on the way back
  float* v_first;         // [N, E], or null
  float* v_extras;        // [N, X], or null
  int64_t gradient_size;  // numbers of a chunk's gradients

  // Tiles of inputs, of activations or their gradients, and panels of transposed inputs.
  int64_t scratch() const { return int64_t(kTile) * (3 * int64_t(widest) + 2 * (first_count + extra_count) + 64); }
};

struct EncodingTask {
  const float* points;  // [N, 3], metres
  int64_t count;        // N
  const float* frequencies;
  int32_t frequency_count;
  const FeatureLevel* levels;
  int32_t level_count;
  int32_t features;    // F, numbers per node
  const float* table;  // [R, F]
  float* out;          // [N, 3 + 6 K + levels F]
  const float* v_out;  // the same, on the way back
  float* v_points;     // [N, 3], or null
  float* v_table;      // [R, F], or null

  int32_t size() const { return 3 + 6 * frequency_count + level_count * features; }
};

struct DistanceTask {
  const float* points;    // [N, 3]
  const float* segments;  // [S, 6]: start and end
  int32_t segment_count;
  float* distance;   // [N]
  float* direction;  // [N, 3], unit vectors away from the nearest segment: the gradient
};

// Parameters [rows, columns] with their gradient, Adam's moments and their moving average, all of the same size.
struct ParameterArray {
  float* values;
  const float* gradient;
  float *first, *second, *average;
  int64_t rows, columns;
  float rate;
  int32_t skips_untouched;  // whether rows without a gradient keep their values and moments
};

struct VariationTask {
  const float* weights;  // [D, H, W, J]
  const uint8_t* used;   // [D, H, W], or null for all
  int64_t nodes[3];      // W, H, D
  int64_t count;         // J
  float scale[3];        // 1 / (side of a cell * number of pairs along the axis)
  float* gradient;       // [D, H, W, J]
  double* totals;        // [D]
};

struct CodeTask {
  const float* seen;    // [N, P]
  const float* codes;   // [B, P, K]
  const int64_t* pose;  // [N], 0 to B - 1
  int32_t parts, size;  // P, K
  float* out;           // [N, K]
  const float* v_out;   // the same, on the way back
};

struct AdamTask;  // snarf/adam.h

struct TrainingKernels {
  // Tiles first to last.
  void (*forward)(const TrainingTask&, int64_t first, int64_t last, float* scratch);
  // Adds the tiles' gradients by weights and biases to `gradients`.
  void (*backward)(const TrainingTask&, int64_t first, int64_t last, float* scratch, float* gradients);
  // Points first to last.
  void (*encode)(const EncodingTask&, int64_t first, int64_t last);
  // Gradients by the points first to last.
  void (*encode_points)(const EncodingTask&, int64_t first, int64_t last);
  // Adds the gradients by the features of one level, from all points.
  void (*encode_level)(const EncodingTask&, int32_t level);
  // Points first to last.
  void (*distances)(const DistanceTask&, int64_t first, int64_t last);
  // Rows first to last.
  void (*adam)(const AdamTask&, const ParameterArray&, int64_t first, int64_t last);
  // Layers first to last.
  void (*variation)(const VariationTask&, int64_t first, int64_t last);
  // Points first to last.
  void (*pose_codes)(const CodeTask&, int64_t first, int64_t last);
  void (*pose_codes_backward)(const CodeTask&, int64_t first, int64_t last, float* v_codes);
  double (*magnitude)(const float* gradient, int64_t count);
};

namespace avx512 {
TrainingKernels training_kernels();
}
namespace avx2 {
TrainingKernels training_kernels();
}
namespace baseline {
TrainingKernels training_kernels();
}

}  // namespace snarf
