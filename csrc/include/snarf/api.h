/* Plain C interface of the CPU library; numbers are float or double by `bytes_per_number` (4 or 8). Poses are B, queries a pose
 * N, nodes V = D H W, cells (D-1)(H-1)(W-1), all arrays dense and row-major. A search is done in two calls, because the number
 * of roots is only known after it: the first returns a handle and the count, the second writes the roots and frees the handle.
 */
#pragma once

#include <stdint.h>

#if defined(_WIN32)
#define SNARF_API __declspec(dllexport)
#else
#define SNARF_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define SNARF_ABI_VERSION 5

enum { SNARF_OK = 0, SNARF_BAD_ARGUMENT = 1, SNARF_OUT_OF_MEMORY = 2 };

typedef struct snarf_field {
  const void* transforms; /* blended transforms at the nodes, [B, V, 12] */
  double lower[3];        /* canonical position of the first node, metres */
  double size[3];         /* sides of a cell, metres */
  int32_t nodes[3];       /* W, H, D */
  int32_t bytes_per_number;
} snarf_field;

typedef struct snarf_queries {
  const void* points; /* [B, N, 3], posed, metres; a non-finite point has no root */
  int64_t poses;      /* B */
  int64_t count;      /* N */
  int32_t threads;    /* at most */
} snarf_queries;

typedef struct snarf_complete {
  const uint8_t* active;          /* cells to search, [(D-1)(H-1)(W-1)], or null for all */
  double tolerance;               /* largest residual of a root, metres */
  int32_t max_steps;              /* Newton steps from one start */
  int32_t orientation_preserving; /* keep only roots with det J > 0 */
} snarf_complete;

typedef struct snarf_broyden {
  /* Upper rows of the inverse bone transforms that give a start, [B, I, 12], posed to canonical; or, with starts_are_points,
   * canonical points, [B, N, I, 3], metres, of which one that is not finite is no start. */
  const void* starts;
  int64_t count;                /* I */
  double tolerance, divergence; /* metres */
  int32_t max_steps;
  int32_t starts_are_points;
  int32_t exact_jacobian;
  int32_t orientation_preserving;
} snarf_broyden;

/* Weights at the nodes and the transforms that they blend (Fast-SNARF Eq. 13). */
typedef struct snarf_blending {
  const void* weights;   /* [V, J] */
  const void* bones;     /* upper three rows, [B, J, 12] */
  const uint8_t* active; /* [(D-1)(H-1)(W-1)]: only the corners of these cells are blended, others get zeros; null for all */
  int64_t poses, count;  /* B, J */
  int32_t nodes[3];      /* W, H, D */
  int32_t bytes_per_number;
  int32_t threads; /* at most */
} snarf_blending;

/* A layer: activation(weights [previous; encoded point; extras] + bias), where it takes only what it says. */
typedef struct snarf_layer {
  const float* weights; /* [outputs, inputs], columns in the order above */
  const float* bias;    /* [outputs] */
  int32_t outputs;
  int32_t takes_point; /* the first layer must */
  int32_t takes_extras;
  int32_t activation; /* 0: none, 1: ReLU, 2: softplus */
} snarf_layer;

/* A level of feature grids over a box. */
typedef struct snarf_feature_level {
  float lower[3];      /* of the first node, metres */
  float size[3];       /* sides of a cell, metres */
  int32_t nodes[3];    /* W, H, D */
  const int32_t* rows; /* row of each node's features in the table, [D, H, W]; zeros where there is no such row, as -1 */
} snarf_feature_level;

/* A canonical occupancy network (SNARF Eq. 1) in one pose; the last layer has one output. */
typedef struct snarf_network {
  const snarf_layer* layers;
  int32_t layer_count;
  const float* frequencies; /* radians per metre, [K]: the encoded point is x, sin(k x) for each k, cos(k x) for each k */
  int32_t frequency_count;
  const snarf_feature_level* levels; /* after the waves, features interpolated at the point join it */
  int32_t level_count;
  int32_t features;      /* F, numbers per node */
  const float* table;    /* [R, F] */
  int64_t rows;          /* R */
  const float* segments; /* bones, [S, 2, 3], metres */
  int32_t segment_count; /* S; 0 for no capsules */
  float radius, slope;   /* slope * (radius - distance to the nearest bone) is added */
  float sharpness;       /* of the softplus */
  int32_t extra_count;   /* E, values of each point's own */
} snarf_network;

/* A fully connected network with gradients. The first inputs stand where `snarf_layer` says "encoded point". */
typedef struct snarf_perceptron {
  const snarf_layer* layers;
  int32_t layer_count;
  int32_t first_count; /* E */
  int32_t extra_count; /* X */
  float sharpness;     /* of the softplus */
  int32_t threads;     /* at most */
} snarf_perceptron;

/* Points encoded as x, sin(k x) for each k, cos(k x) for each k, then the features of each level, interpolated. */
typedef struct snarf_encoding {
  const float* points;      /* [N, 3], metres */
  int64_t count;            /* N */
  const float* frequencies; /* radians a metre, [K] */
  int32_t frequency_count;
  const snarf_feature_level* levels;
  int32_t level_count;
  int32_t features;   /* F, numbers per node */
  const float* table; /* [R, F] */
  int64_t rows;       /* R */
  int32_t threads;    /* at most */
} snarf_encoding;

/* Parameters [rows, columns] with their gradient, Adam's moments and the moving average of the parameters. */
typedef struct snarf_parameters {
  float* values;
  const float* gradient;
  float* first; /* moments of the gradient */
  float* second;
  float* average;
  int64_t rows, columns;
  float rate;
  int32_t skips_untouched; /* rows whose gradient is all zero keep their values and moments */
} snarf_parameters;

typedef struct snarf_adam {
  int64_t step; /* 1 for the first */
  float first_decay, second_decay, epsilon;
  float average_decay;
  int32_t threads; /* at most */
} snarf_adam;

/* Points that see the P parts of a pose's code by different shares. */
typedef struct snarf_codes {
  const float* seen;    /* [N, P] */
  const int64_t* pose;  /* [N], 0 to B - 1 */
  int64_t count, poses; /* N, B */
  int32_t parts, size;  /* P, K */
  int32_t threads;      /* at most */
} snarf_codes;

/* Skinning weights at the nodes of a grid, whose changes are added up. */
typedef struct snarf_variation {
  const float* weights; /* [D, H, W, J] */
  const uint8_t* used;  /* which nodes count, [D, H, W], or null for all */
  int32_t nodes[3];     /* W, H, D */
  int32_t count;        /* J */
  double size[3];       /* sides of a cell, metres */
  int32_t threads;      /* at most */
} snarf_variation;

typedef struct snarf_roots snarf_roots;
typedef struct snarf_prepared snarf_prepared;

SNARF_API int snarf_abi_version(void);
/* Name of the instruction set in use: avx512, avx2 or baseline. SNARF_INSTRUCTION_SET in the environment may ask for a lower
 * one. */
SNARF_API const char* snarf_instruction_set(void);

/* transforms [B, V, 12]. */
SNARF_API int snarf_blend(const snarf_blending*, void* transforms);
/* Gradients of a loss by the weights [V, J] and by the bones [B, J, 12] from that by the transforms [B, V, 12]; either result
 * may be null, both are overwritten. */
SNARF_API int snarf_blend_backward(const snarf_blending*, const void* gradient, void* v_weights, void* v_bones);

SNARF_API int snarf_complete_search(const snarf_field*, const snarf_queries*, const snarf_complete*, snarf_roots** roots,
                                    int64_t* found);
SNARF_API int snarf_broyden_search(const snarf_field*, const snarf_queries*, const snarf_broyden*, snarf_roots** roots,
                                   int64_t* found);

/* Sorts the cells of poses by their posed images, for many complete searches with few queries each. The first call returns a
 * handle and the size of a buffer; the second writes the buffer, the lower and upper corner of the box around the images of
 * each pose, [B, 2, 3], metres (infinite if there is no cell to search), and frees the handle. Null pointers only free it. The
 * buffer is plain data without pointers, aligned to 64 bytes, of this machine and this version of the library. */
SNARF_API int snarf_prepare(const snarf_field*, int64_t poses, const uint8_t* active, int32_t threads, snarf_prepared**,
                            int64_t* bytes);
SNARF_API int snarf_take_prepared(snarf_prepared*, void* buffer, void* boxes);
/* As `snarf_complete_search` in the prepared cells; `field` is that of the preparation and `active` is not read. */
SNARF_API int snarf_prepared_search(const void* buffer, int64_t bytes, const snarf_field*, const snarf_queries*,
                                    const snarf_complete*, snarf_roots** roots, int64_t* found);

/* canonical [M, 3], query [M] (b N + n, ascending), jacobian_inverse [M, 3, 3]. Frees the handle; null pointers only free it.
 */
SNARF_API int snarf_take_roots(snarf_roots* roots, void* canonical, int64_t* query, void* jacobian_inverse);

/* Gradients of a loss by the queries [B, N, 3] and by the nodes' transforms [B, V, 12], from that by the roots, [M, 3]; they
 * are added to the results, of which either may be null. `field.transforms` is not read. */
SNARF_API int snarf_implicit_backward(const snarf_field*, const snarf_queries*, int64_t roots, const void* gradient,
                                      const void* canonical, const int64_t* query, const void* jacobian_inverse, void* v_points,
                                      void* v_transforms);

/* Logits [N] at points [N, 3], metres, with extras [N, E]; always float. A point's result does not depend on the others. */
SNARF_API int snarf_evaluate(const snarf_network*, const float* points, const float* extras, int64_t count, int32_t threads,
                             float* logits);

/* Numbers of the activations that `snarf_forward` saves for `count` points; negative for a network that is none. */
SNARF_API int64_t snarf_saved_size(const snarf_perceptron*, int64_t count);
/* out [N, O] of first [N, E] and extras [N, X]. */
SNARF_API int snarf_forward(const snarf_perceptron*, const float* first, const float* extras, int64_t count, float* saved,
                            float* out);
/* Gradients of a loss from that by `out`: by each layer's weights and bias, by the first inputs and by the extras (either may
 * be null). All are overwritten; the results do not depend on the number of threads. */
SNARF_API int snarf_backward(const snarf_perceptron*, const float* first, const float* extras, int64_t count,
                             const float* saved, const float* v_out, float* const* v_weights, float* const* v_bias,
                             float* v_first, float* v_extras);

/* out [N, 3 + 6 K + levels F]. */
SNARF_API int snarf_encode(const snarf_encoding*, float* out);
/* Gradients from that by `out`, which is as `snarf_encode` wrote it; either result may be null, both are overwritten. */
SNARF_API int snarf_encode_backward(const snarf_encoding*, const float* out, const float* v_out, float* v_points,
                                    float* v_table);

/* Distances [N] of points [N, 3] to the nearest of S >= 1 segments [S, 2, 3], and the unit vectors [N, 3] away from it, which
 * are the gradients. */
SNARF_API int snarf_segment_distances(const float* points, int64_t count, const float* segments, int32_t segment_count,
                                      int32_t threads, float* distance, float* direction);

/* out [N, K]: the sum over p of seen[n, p] codes[pose[n], p], for codes [B, P, K]. */
SNARF_API int snarf_pose_codes(const snarf_codes*, const float* codes, float* out);
/* The gradient by the codes from that by `out`; it does not depend on the number of threads. */
SNARF_API int snarf_pose_codes_backward(const snarf_codes*, const float* v_out, float* v_codes);

/* Changes of the weights from node to node, per metre: summed over bones and axes, averaged over the pairs of neighbours along
 * an axis that both count; and the gradient [D, H, W, J] of that. */
SNARF_API int snarf_total_variation(const snarf_variation*, double* total, float* gradient);

/* One step of Adam (Kingma and Ba 2015, Algorithm 1) and of the average. `magnitude` becomes the sum of the magnitudes of all
 * gradients; nothing else changes if it is not finite. Results do not depend on the number of threads. */
SNARF_API int snarf_adam_step(const snarf_parameters*, int32_t count, const snarf_adam*, double* magnitude);

#ifdef __cplusplus
}
#endif
