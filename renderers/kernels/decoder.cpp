// Values of a ReLU network at points, without a graph: the features of a tile of points stay in the first caches.
// The same in PyTorch is `BoundDecoder._forward` in renderers/fields/mlp.py.
#include <cstdint>
#include <cstring>
#include <memory>

#if defined(__AVX512F__)
constexpr int LANES = 16, VECTORS = 4;  // 24 of 32 registers hold sums
#else
constexpr int LANES = 8, VECTORS = 2;  // 12 of 16
#endif
constexpr int BLOCK = LANES * VECTORS;  // neurons whose weights are contiguous: [outputs / BLOCK][inputs][BLOCK]
constexpr int ROWS = 6;                 // points whose sums are kept in registers
constexpr int TILE = 8 * ROWS;          // points that pass through all layers together

typedef float Vector __attribute__((vector_size(4 * LANES), aligned(4)));

struct Decoder {
  int layers, skip;              // hidden layers; index of the one that also takes the point, 0 for none
  const int *inputs, *outputs;   // of each hidden layer; outputs are a multiple of BLOCK
  const float *const *weights, *const *biases;
  const float *last;             // weights, as many as the outputs of the last hidden layer
  float last_bias;
};

struct Rows {  // features of points, one row each
  float *start;
  int stride;
  float *at(int row) const { return start + (size_t)row * stride; }
};

// One block of neurons of R points, from inputs to the ReLU of their sums.
template <int R>
static inline void block(Rows from, int inputs, const float *weight, const float *bias, Rows to) {
  Vector sum[R][VECTORS];
  for (int j = 0; j < VECTORS; j++)
    for (int r = 0; r < R; r++) sum[r][j] = *(const Vector *)(bias + LANES * j);
  for (int k = 0; k < inputs; k++, weight += BLOCK) {
    Vector column[VECTORS];
    for (int j = 0; j < VECTORS; j++) column[j] = *(const Vector *)(weight + LANES * j);
#pragma GCC unroll 6
    for (int r = 0; r < R; r++)
      for (int j = 0; j < VECTORS; j++) sum[r][j] += from.at(r)[k] * column[j];
  }
  for (int r = 0; r < R; r++)
    for (int j = 0; j < VECTORS; j++)  // NaN stays NaN, as in PyTorch
      *(Vector *)(to.at(r) + LANES * j) = sum[r][j] < 0 ? Vector{} : sum[r][j];
}

template <int R>
static void partial_block(int rows, Rows from, int inputs, const float *weight, const float *bias, Rows to) {
  if (rows == R) return block<R>(from, inputs, weight, bias, to);
  if constexpr (R > 1) partial_block<R - 1>(rows, from, inputs, weight, bias, to);
}

static void layer(const Decoder *net, int index, Rows from, int points, Rows to) {
  int inputs = net->inputs[index];
  const float *weight = net->weights[index];
  for (int o = 0; o < net->outputs[index]; o += BLOCK, weight += (size_t)BLOCK * inputs)
    for (int r = 0; r < points; r += ROWS)
      partial_block<ROWS>(points - r < ROWS ? points - r : ROWS, {from.at(r), from.stride}, inputs, weight,
                          net->biases[index] + o, {to.at(r) + o, to.stride});
}

static float sum_last(const Decoder *net, const float *features) {
  Vector sums = {};
  for (int k = 0; k < net->outputs[net->layers - 1]; k += LANES)
    sums += *(const Vector *)(features + k) * *(const Vector *)(net->last + k);
  float sum = net->last_bias;
  for (int j = 0; j < LANES; j++) sum += sums[j];
  return sum;
}

extern "C" int decoder_block() { return BLOCK; }

extern "C" void decoder_values(const Decoder *net, float *points, int64_t count, float *values) {
  int stride = 0;
  for (int l = 0; l < net->layers; l++) stride = net->outputs[l] > stride ? net->outputs[l] : stride;
  stride += LANES;  // the point follows the features
  std::unique_ptr<float[]> buffer(new float[2 * (size_t)TILE * stride]);
  for (int64_t first = 0; first < count; first += TILE) {
    int rows = count - first < TILE ? (int)(count - first) : TILE;
    Rows tile = {points + 3 * first, 3}, from = {buffer.get(), stride}, to = {from.at(TILE), stride};
    layer(net, 0, tile, rows, from);
    for (int l = 1; l < net->layers; l++) {
      if (l == net->skip)
        for (int r = 0; r < rows; r++) memcpy(from.at(r) + net->inputs[l] - 3, tile.at(r), 3 * sizeof(float));
      layer(net, l, from, rows, to);
      Rows swapped = from;
      from = to, to = swapped;
    }
    for (int r = 0; r < rows; r++) values[first + r] = sum_last(net, from.at(r));
  }
}
